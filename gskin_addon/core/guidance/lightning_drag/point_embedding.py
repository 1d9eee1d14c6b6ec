# SPDX-License-Identifier: GPL-3.0-or-later
"""LightningDrag's point embedding: two maps of numbered pixels to features at four resolutions."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional

WIDTH = 32
"""Channels after the first convolution of the published model."""


def _conv(inner: int, outer: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inner, outer, 3, stride=stride, padding=1, bias=False)


class _Halve(nn.Module):
    def __init__(self, inner: int, outer: int) -> None:
        super().__init__()
        self.conv1 = _conv(inner, outer, stride=2)
        self.conv2 = _conv(outer, outer)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.silu(self.conv2(functional.silu(self.conv1(x))))


class PointEmbedding(nn.Module):
    """Maps (B, 2, H, W) -> features of handles and of targets at 1/8, 1/16, 1/32 and 1/64.

    `width` w gives 8w, 16w, 32w, 64w channels there, of which handles and targets have one half each:
    E = 128, 256, 512, 1024 for the published w = 32. Thirteen convolutions without bias.
    """

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        w = width
        self.conv_in = _conv(2, w)
        self.downsample_blocks_vae = nn.ModuleList(_Halve(w << k, w << (k + 1)) for k in range(3))
        self.downsample_blocks_unet = nn.ModuleList(_Halve(w << k, w << (k + 1)) for k in range(3, 6))

    @property
    def embeddings(self) -> tuple[int, ...]:
        """Width E at each resolution, fine to coarse."""
        return tuple((self.conv_in.out_channels << level) // 2 for level in range(3, 7))

    def forward(self, maps: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """(handles, targets), each four tensors (B, tokens, E), fine to coarse, tokens in rows."""
        x = self.conv_in(maps)
        for block in self.downsample_blocks_vae:
            x = block(x)
        features = [x]
        for block in self.downsample_blocks_unet:
            features.append(block(features[-1]))
        halves = [feature.flatten(2).transpose(1, 2).chunk(2, dim=-1) for feature in features]
        return [handle for handle, _ in halves], [target for _, target in halves]


def width_of(state: Mapping[str, torch.Tensor]) -> int:
    """The `width` of a saved point embedding; the published one where it cannot be told."""
    first = state.get("conv_in.weight")
    return WIDTH if first is None or first.ndim != 4 else int(first.shape[0])
