# SPDX-License-Identifier: GPL-3.0-or-later
"""What a picture of a window shows, in numbers: is there anything at all, and does it differ from another one?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

FAINT = 12
"""Steps of 255 within which two colours are called the same."""


@dataclass(frozen=True)
class Look:
    """A picture in numbers. filled: share of pixels unlike the background, colours: how many different ones."""

    filled: float
    colours: int

    def __str__(self) -> str:
        return f"{self.filled:.0%} filled, {self.colours} colours"


def read(path: Path, box: Sequence[int] | None = None) -> np.ndarray:
    """The colours (H, W, 3) uint8 of a picture, or of its part (left, upper, right, lower) in pixels."""
    image = Image.open(path).convert("RGB")
    return np.asarray(image.crop(tuple(box)) if box else image)


def look(pixels: np.ndarray) -> Look:
    """The background is the colour that most pixels have."""
    flat = pixels.reshape(-1, 3)
    colours, counts = np.unique(flat, axis=0, return_counts=True)
    background = colours[counts.argmax()].astype(int)
    filled = np.abs(flat.astype(int) - background).max(axis=1) > FAINT
    return Look(float(filled.mean()), len(colours))


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """The share of pixels that differ between two pictures of one size."""
    return float((np.abs(before.astype(int) - after.astype(int)).max(axis=2) > FAINT).mean())
