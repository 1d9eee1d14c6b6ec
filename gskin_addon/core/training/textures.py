# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures of a rigged mesh in an npz file, and their colours at splats. numpy only.

Arrays, all optional together: corner_uv (F, 3, 2) with (0, 0) at the lower left of a texture; face_texture (F,) index
of the triangle's texture, -1 for none; texture_0, texture_1, ... (H, W, 3) uint8 sRGB, top row first, the material's
factor in it; corner_tint (F, 3, 3) uint8, linear, what vertex colours multiply the texture by.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

NAMES = ("corner_uv", "face_texture")


@dataclass(frozen=True, eq=False)
class Textures:
    """corner_uv (F, 3, 2); face_texture (F,), -1 for triangles without; images: (H, W, 3) uint8 sRGB each;
    corner_tint (F, 3, 3) in [0, 1], linear, or None."""

    corner_uv: NDArray[Any]
    face_texture: NDArray[Any]
    images: tuple[NDArray[np.uint8], ...]
    corner_tint: NDArray[Any] | None = None

    def colors(self, face: NDArray[Any], bary: NDArray[Any]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Which of N points have a texture (N,), and the sRGB colours (N, 3) in [0, 1] of those, the others 0.

        face (N,), bary (N, 3): where on the mesh the points lie. Pixels are mixed linearly; textures repeat.
        """
        chosen = self.face_texture[face]
        colors = np.zeros((len(face), 3))
        uv = np.einsum("nk,nkd->nd", bary, self.corner_uv[face].astype(np.float64))
        for number, image in enumerate(self.images):
            here = chosen == number
            colors[here] = sample_image(image, uv[here])
        if self.corner_tint is not None:
            tint = np.einsum("nk,nkc->nc", bary, self.corner_tint[face])
            colors = to_srgb(to_linear(colors) * tint)
        has = chosen >= 0
        colors[~has] = 0
        return has, colors


def read_textures(data: Mapping[str, NDArray[Any]], faces: int) -> Textures | None:
    """The textures among a file's arrays, None where it has none. Raises ValueError where they do not fit together."""
    if not all(name in data for name in NAMES):
        return None
    uv, chosen = data["corner_uv"], data["face_texture"].astype(int)
    images: list[NDArray[np.uint8]] = []
    while (image := data.get(f"texture_{len(images)}")) is not None:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
            raise ValueError(f"texture_{len(images)} is no picture")
        images.append(image)
    if uv.shape != (faces, 3, 2) or chosen.shape != (faces,) or chosen.max(initial=-1) >= len(images):
        raise ValueError("corner_uv or face_texture does not fit the faces and textures")
    if not np.isfinite(uv).all():
        raise ValueError("corner_uv is not finite")
    tint = data.get("corner_tint")
    if tint is not None and tint.shape != (faces, 3, 3):
        raise ValueError("corner_tint does not fit the faces")
    return Textures(uv, chosen, tuple(images), None if tint is None else tint / 255.0)


def sample_image(image: NDArray[np.uint8], uv: NDArray[Any]) -> NDArray[np.float64]:
    """Colours (N, 3) in [0, 1] of `image` (H, W, 3), top row first, at uv (N, 2), mixed from four pixels each."""
    height, width = image.shape[:2]
    x, y = (uv[:, 0] % 1.0) * width - 0.5, (1.0 - uv[:, 1] % 1.0) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - left)[:, None], (y - top)[:, None]

    def pixel(row: NDArray[Any], column: NDArray[Any]) -> NDArray[Any]:
        return image[row % height, column % width].astype(np.float64) / 255.0

    upper = pixel(top, left) * (1 - fx) + pixel(top, left + 1) * fx
    lower = pixel(top + 1, left) * (1 - fx) + pixel(top + 1, left + 1) * fx
    mixed: NDArray[np.float64] = upper * (1 - fy) + lower * fy
    return mixed


def to_linear(color: NDArray[Any]) -> NDArray[np.float64]:
    """sRGB in [0, 1] as linear light (IEC 61966-2-1)."""
    color = np.clip(color, 0.0, 1.0)
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def to_srgb(light: NDArray[Any]) -> NDArray[np.float64]:
    """Linear light in [0, 1] as sRGB."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
