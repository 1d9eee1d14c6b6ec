# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertices and triangles of a Wavefront .obj in the file's own order, which weights by vertex number need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[Any]

_LARGEST = 1 << 30


def read_obj(path: Path) -> tuple[Array, Array]:
    """Vertices (V, 3) float64 with the file's own axes, and triangles (F, 3) int64; polygons as fans.

    Raises InputError: missing, no .obj, faces of vertices that do not exist.
    """
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path of the mesh.")
    if path.stat().st_size > _LARGEST:
        raise InputError(f"'{path}' has {path.stat().st_size >> 20:,} MB; give a smaller mesh.")
    verts: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                words = line.split()
                if not words:
                    continue
                if words[0] == "v":
                    x, y, z = words[1:4]
                    verts.append((float(x), float(y), float(z)))
                elif words[0] == "f":
                    corner = [int(word.partition("/")[0]) for word in words[1:]]
                    # From 1 on; negative ones count back from the vertices so far.
                    at = [index - 1 if index > 0 else len(verts) + index for index in corner]
                    if 0 in corner or min(at) < 0:
                        raise ValueError("a face of a vertex that does not exist")
                    faces += [(at[0], at[k], at[k + 1]) for k in range(1, len(at) - 1)]
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(f"'{path}' is no mesh that can be read ({error}); export it again as .obj.") from None
    points, triangles = np.array(verts, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)
    if not len(triangles):
        raise InputError(f"'{path}' has no faces; export the mesh with its surface.")
    if triangles.max() >= len(points):
        raise InputError(f"'{path}' has faces of vertices that do not exist; export it again.")
    if not np.isfinite(points).all():
        raise InputError(f"'{path}' has vertices that are not finite; clean it up and export it again.")
    return points, triangles
