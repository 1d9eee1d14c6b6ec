# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasteriser's meaning in float64 torch: slow, splat by splat over whole images, for autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from .camera import Camera


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Rotation matrices (N,3,3) of quaternions (N,4) wxyz, normalised first."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1).reshape(-1, 3, 3)  # fmt: skip


def image_axes(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N,2), depths (N,), and U (N,2,3): U U^T is the undilated image covariance (Zwicker et al. 2001)."""
    W = torch.as_tensor(camera.rotation, dtype=means.dtype, device=means.device)
    p = means @ W.T + torch.as_tensor(camera.translation, dtype=means.dtype, device=means.device)
    x, y, z = p.unbind(-1)
    if camera.orthographic:
        pixels = torch.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], -1)
        J = torch.tensor([[camera.fx, 0.0, 0.0], [0.0, camera.fy, 0.0]], dtype=means.dtype, device=means.device)
        return pixels, z, J @ W @ (quat_to_matrix(quats) * scales[:, None, :])
    pixels = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    edge_x, edge_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    u = (x / z).clamp(-camera.cx / camera.fx - edge_x, (camera.width - camera.cx) / camera.fx + edge_x)
    v = (y / z).clamp(-camera.cy / camera.fy - edge_y, (camera.height - camera.cy) / camera.fy + edge_y)
    nil = torch.zeros_like(z)
    J = torch.stack([camera.fx / z, nil, -camera.fx * u / z, nil, camera.fy / z, -camera.fy * v / z], -1)
    V = quat_to_matrix(quats) * scales[:, None, :]
    return pixels, z, J.reshape(-1, 2, 3) @ W @ V


def project(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N,2), depths (N,), undilated image covariances (N,2,2)."""
    pixels, z, U = image_axes(means, quats, scales, camera)
    return pixels, z, U @ U.transpose(1, 2)


def render(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    colors: Tensor,
    opacities: Tensor,
    camera: Camera,
    background: Tensor,
    *,
    dilation: float = 0.3,
    compensate: float | None = None,
) -> tuple[Tensor, Tensor]:
    """(image (H,W,3), alpha (H,W)) of means (N,3), quats (N,4) wxyz, scales (N,3), colors (N,3), opacities
    (N,).

    Everything is taken to float64. Splats at depth <= camera.near are not drawn; alpha is at most 0.99 and
    cut below 1/255; a pixel ends before the splat that would take its transmittance to 1e-4 or less.
    """
    means, quats, scales, colors, opacities, background = (
        t.to(torch.float64) for t in (means, quats, scales, colors, opacities, background)
    )
    rows = torch.arange(camera.height, dtype=torch.float64)[:, None] + 0.5
    columns = torch.arange(camera.width, dtype=torch.float64)[None, :] + 0.5
    pixels, depth, cov = project(means, quats, scales, camera)
    eye = torch.eye(2, dtype=torch.float64)
    blurred = cov + dilation * eye
    opacity = opacities
    if compensate is not None:
        opacity = opacities * torch.sqrt(torch.linalg.det(cov + compensate * eye) / torch.linalg.det(blurred))
    conic = torch.linalg.inv(blurred)
    T = torch.ones(camera.height, camera.width, dtype=torch.float64)
    stopped = torch.zeros_like(T, dtype=torch.bool)
    image = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    for i in torch.argsort(depth, stable=True).tolist():
        if not depth[i] > camera.near:
            continue
        dx, dy = columns - pixels[i, 0], rows - pixels[i, 1]
        q = conic[i, 0, 0] * dx * dx + 2 * conic[i, 0, 1] * dx * dy + conic[i, 1, 1] * dy * dy
        alpha = opacity[i] * torch.exp(-0.5 * q)
        drawn = (alpha >= 1 / 255) & ~stopped
        alpha = alpha.clamp(max=0.99)
        stopped = stopped | (drawn & (T * (1 - alpha) <= 1e-4))
        alpha = torch.where(drawn & ~stopped, alpha, torch.zeros_like(alpha))
        image = image + (T * alpha)[..., None] * colors[i]
        T = T * (1 - alpha)
    return image + T[..., None] * background, 1 - T
