# SPDX-License-Identifier: GPL-3.0-or-later
"""The source image as four tokens beside the text (IP-Adapter, Ye et al. 2023)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

TOKENS = 4
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class ImageTokens(nn.Module):
    """CLIP image embeddings (B, width) -> (B, 4, context): a linear layer and a LayerNorm."""

    def __init__(self, width: int, context: int) -> None:
        super().__init__()
        self.proj = nn.Linear(width, TOKENS * context)
        self.norm = nn.LayerNorm(context)

    def forward(self, embeds: torch.Tensor) -> torch.Tensor:
        tokens: torch.Tensor = self.norm(self.proj(embeds).reshape(len(embeds), TOKENS, -1))
        return tokens


def clip_pixels(image: NDArray[Any], side: int) -> torch.Tensor:
    """An image (H, W, 3) in [0, 1] as CLIP takes it, (1, 3, side, side) float32: shorter side resized by bicubic
    interpolation, the middle cut out, CLIP's mean and deviation taken out."""
    from PIL import Image

    picture = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
    scale = side / min(picture.size)
    width, height = (max(side, round(length * scale)) for length in picture.size)
    picture = picture.resize((width, height), Image.Resampling.BICUBIC)
    left, top = (width - side) // 2, (height - side) // 2
    picture = picture.crop((left, top, left + side, top + side))
    pixels = (np.asarray(picture, np.float32) / 255 - CLIP_MEAN) / CLIP_STD
    return torch.from_numpy(pixels.astype(np.float32)).permute(2, 0, 1)[None]
