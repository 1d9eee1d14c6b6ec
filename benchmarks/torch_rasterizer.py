# SPDX-License-Identifier: GPL-3.0-or-later
"""A tiled splat rasteriser in plain torch operations: the yardstick for the numba kernels, no part of the add-on.

Tiles see their splats as one (splats, pixels) block; autograd keeps everything for the backward pass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gskin_addon.core.render.camera import Camera
from gskin_addon.core.render.reference import project

TILE = 16


def render(
    means: Tensor, quats: Tensor, scales: Tensor, colors: Tensor, opacities: Tensor, camera: Camera, background: Tensor
) -> Tensor:
    """Image (H,W,3) of means (N,3), quats (N,4), scales (N,3), colors (N,3), opacities (N,), in their own dtype."""
    pixels, depth, cov = project(means, quats, scales, camera)
    cov = cov + 0.3 * torch.eye(2, dtype=cov.dtype)
    conic = torch.linalg.inv(cov)
    with torch.no_grad():
        reach = 2 * torch.log((255 * opacities).clamp(min=1))
        extent = torch.sqrt(reach[:, None] * torch.diagonal(cov, dim1=1, dim2=2))
        order = torch.argsort(depth)
        order = order[(depth[order] > camera.near) & (255 * opacities[order] >= 1)]
        lower, upper = (pixels - extent)[order], (pixels + extent)[order]
    strips = []
    for y0 in range(0, camera.height, TILE):
        rows = min(TILE, camera.height - y0)
        in_row = (upper[:, 1] > y0) & (lower[:, 1] < y0 + rows)
        row_lower, row_upper, row_order = lower[in_row], upper[in_row], order[in_row]
        tiles = []
        for x0 in range(0, camera.width, TILE):
            columns = min(TILE, camera.width - x0)
            index = row_order[(row_upper[:, 0] > x0) & (row_lower[:, 0] < x0 + columns)]
            tiles.append(_tile(index, x0, y0, columns, rows, pixels, conic, colors, opacities, background))
        strips.append(torch.cat(tiles, 1))
    return torch.cat(strips, 0)


def _tile(
    index: Tensor, x0: int, y0: int, columns: int, rows: int, pixels: Tensor, conic: Tensor, colors: Tensor,
    opacities: Tensor, background: Tensor,
) -> Tensor:  # fmt: skip
    if len(index) == 0:
        return background.expand(rows, columns, 3)
    x = torch.arange(x0, x0 + columns, dtype=pixels.dtype) + 0.5
    y = torch.arange(y0, y0 + rows, dtype=pixels.dtype) + 0.5
    dx, dy = x[None, None, :] - pixels[index, 0, None, None], y[None, :, None] - pixels[index, 1, None, None]
    a, b, c = (conic[index, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    alpha = opacities[index, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha >= 1 / 255, alpha.clamp(max=0.99), torch.zeros_like(alpha)).flatten(1)
    after = torch.cumprod(1 - alpha, 0)
    alpha = torch.where(after > 1e-4, alpha, torch.zeros_like(alpha))
    T = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(T[:1]), T[:-1]])
    image = (alpha * before).T @ colors[index] + T[-1][:, None] * background
    return image.reshape(rows, columns, 3)
