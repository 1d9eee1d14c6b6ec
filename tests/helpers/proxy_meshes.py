# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes for the tests of anchored splats."""

from __future__ import annotations

import numpy as np


def tube(bones: int = 3, rings: int = 25, sides: int = 12, radius: float = 0.12) -> tuple[np.ndarray, np.ndarray]:
    """The open tube of `make_limb`, along x: verts (V, 3), faces (F, 3)."""
    x, angle = np.linspace(0, bones, rings), np.linspace(0, 2 * np.pi, sides, endpoint=False)
    xx, aa = np.meshgrid(x, angle, indexing="ij")
    verts = np.stack([xx, radius * np.cos(aa), radius * np.sin(aa)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + j).ravel(), (i * sides + (j + 1) % sides).ravel()
    faces = np.concatenate([np.stack([a, a + sides, b], 1), np.stack([b, a + sides, b + sides], 1)])
    return verts, faces


def grid(size: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A flat square sheet in the xy plane, side 1: verts, faces."""
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="ij")
    verts = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(size - 1), np.arange(size - 1), indexing="ij")
    a = (i * size + j).ravel()
    faces = np.concatenate([np.stack([a, a + size, a + 1], 1), np.stack([a + 1, a + size, a + size + 1], 1)])
    return verts, faces
