# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays as textures.

Blender's Python has no storage buffers and cannot write into a texture: each change makes a new one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.render.drawn_splats import DrawnSplats
from .shaders import WIDTH, gpu_types


def _texture(values: NDArray[Any], width: int, height: int, form: str) -> Any:
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    buffer = gpu_types.Buffer("FLOAT", flat.size, flat)
    return gpu_types.GPUTexture((width, height), format=form, data=buffer)


def _rows(count: int) -> int:
    return max(1, -(-count // WIDTH))


def splat_texture(parts: Sequence[tuple[NDArray[Any], Any]]) -> Any:
    """RGBA32F of rows (N, 3) with a fourth value, a number or (N,), part after part, `WIDTH` texels a row."""
    count = sum(len(rows) for rows, _ in parts)
    values = np.zeros((_rows(count) * WIDTH, 4), np.float32)
    first = 0
    for rows, last in parts:
        here = values[first : first + len(rows)]
        here[:, : rows.shape[1]] = rows
        if rows.shape[1] < 4:
            here[:, 3] = last
        first += len(rows)
    return _texture(values, WIDTH, _rows(count), "RGBA32F")


def texel_texture(texels: NDArray[Any]) -> Any:
    """RGBA32F of texels (N, 4), `WIDTH` a row."""
    return splat_texture([(texels, 0.0)])


def order_texture(order: NDArray[Any]) -> Any:
    """R32F of an index (N,): float32 counts exactly to 16.7 million."""
    values = np.zeros(_rows(len(order)) * WIDTH, np.float32)
    values[: len(order)] = order
    return _texture(values, WIDTH, _rows(len(order)), "R32F")


def image_texture(values: NDArray[Any]) -> Any:
    """R32F of a picture (H, W), its first row the lowest."""
    return _texture(values, values.shape[1], values.shape[0], "R32F")


def object_texture(matrices: Sequence[NDArray[Any]]) -> Any:
    """Three texels for each object: the rows of its matrix (4, 4) to view axes."""
    rows = np.concatenate([np.asarray(matrix)[:3] for matrix in matrices])
    return _texture(rows, len(rows), 1, "RGBA32F")


@dataclass(frozen=True)
class PoseTextures:
    """What changes with the pose and not with the view. count: of splats, all objects together."""

    points: Any
    rotations: Any
    scales: Any
    count: int


def pose_textures(objects: Sequence[DrawnSplats]) -> PoseTextures:
    """The objects' splats one after the other, each with the number of its object."""
    return PoseTextures(
        points=splat_texture([(splats.points, number) for number, splats in enumerate(objects)]),
        rotations=splat_texture([(splats.rotations, 0.0) for splats in objects]),
        scales=splat_texture([(splats.scales, 0.0) for splats in objects]),
        count=sum(splats.count for splats in objects),
    )


def color_texture(colors: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Any:
    """Colours (N, 3) and opacities (N,) of each object."""
    return splat_texture(colors)
