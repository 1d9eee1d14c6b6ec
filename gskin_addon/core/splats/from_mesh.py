# SPDX-License-Identifier: GPL-3.0-or-later
"""Turn a coloured triangle mesh into splats, as image-to-3D generators and captures leave them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .cloud import SplatCloud

_SH_C0 = 0.28209479177387814


def sample_mesh(
    verts: NDArray[Any],
    faces: NDArray[Any],
    corner_rgb: NDArray[Any],
    count: int,
    rng: np.random.Generator,
    *,
    below: float = 0.15,
    scatter: float = 0.002,
    flatness: float = 0.25,
) -> tuple[SplatCloud, NDArray[np.int64], NDArray[np.float64]]:
    """Cover a mesh with `count` splats, uniformly by area.

    Args:
        verts: (V, 3) positions in metres.
        faces: (F, 3) vertex indices.
        corner_rgb: (F, 3, 3) sRGB colour in [0, 1] of each triangle corner.
        count: number of splats, at least 1.
        rng: source of all randomness.
        below: share of the splats that sits below the surface (captures have some).
        scatter: standard deviation of the offset along the normal, as a part of the bounding-box diagonal.
        flatness: thickness of a splat over its radius.

    Returns:
        The cloud (SH degree 0), the triangle of every splat (N,), and its barycentric coordinates (N, 3),
        by which attributes of the vertices (skinning weights, say) reach the splats.

    Raises:
        InputError: the mesh has no triangle with an area.
    """
    verts = np.asarray(verts, np.float64)
    corners = verts[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(normal, axis=1)
    total = double_area.sum()
    if count < 1 or not total > 0:
        raise InputError("The mesh has no surface to put splats on: give it triangles with an area.")
    # Stratified positions along the running area: less clumping than independent draws.
    position = (np.arange(count) + rng.random(count)) / count * total
    face = np.searchsorted(np.cumsum(double_area), position).clip(0, len(faces) - 1)
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    bary = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    unit = normal[face] / np.maximum(double_area[face], 1e-30)[:, None]

    diagonal = float(np.linalg.norm(verts.max(0) - verts.min(0)))
    offset = rng.normal(0.0, scatter * diagonal, count)
    buried = rng.random(count) < below
    offset[buried] = -np.abs(offset[buried]) - rng.random(int(buried.sum())) * 2 * scatter * diagonal
    means = np.einsum("nk,nkd->nd", bary, corners[face]) + offset[:, None] * unit

    # A disc of the area that one splat stands for, widened so that neighbours overlap, and jittered.
    radius = np.sqrt(0.5 * total / count / np.pi) * 1.1
    scales = radius * np.exp(rng.normal(0.0, 0.2, (count, 3)))
    scales[:, 2] *= flatness
    color = np.einsum("nk,nkc->nc", bary, np.asarray(corner_rgb, np.float64)[face])
    opacities = rng.uniform(0.85, 0.99, count)
    cloud = SplatCloud(
        means=means.astype(np.float32),
        quats=_quats_with_z(unit, rng).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=opacities.astype(np.float32),
        sh=((color - 0.5) / _SH_C0)[:, None, :].astype(np.float32),
    )
    return cloud, face, bary


def _quats_with_z(axis: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Unit quaternions (N, 4) wxyz that turn +z to `axis` (N, 3), with a random spin about it."""
    swing = np.stack([1 + axis[:, 2], -axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    length = np.linalg.norm(swing, axis=1, keepdims=True)
    swing = np.where(length > 1e-6, swing / np.maximum(length, 1e-6), [0.0, 1.0, 0.0, 0.0])
    half = rng.uniform(0, np.pi, len(axis))
    c, s = np.cos(half), np.sin(half)
    w, x, y, _ = swing.T  # times the spin (c, 0, 0, s)
    return np.stack([w * c, x * c + y * s, y * c - x * s, w * s], axis=1)
