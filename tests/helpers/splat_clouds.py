# SPDX-License-Identifier: GPL-3.0-or-later
"""Random splat clouds, and PLY files written by the independent `plyfile` package."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import plyfile

from gskin_addon.core.splats.cloud import SplatCloud

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).resolve().parents[3] / "shared" / "assets"))


def random_cloud(count: int, degree: int, seed: int = 0) -> SplatCloud:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return SplatCloud(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-4.0, 1.0, size=(count, 3))),
        opacities=rng.uniform(0.0, 1.0, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def raw_columns(count: int, degree: int, seed: int = 0) -> dict[str, np.ndarray[Any, Any]]:
    """float32 columns as a trainer would store them, in INRIA order."""
    rng = np.random.default_rng(seed)
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return {name: rng.normal(0.0, 3.0, count).astype(np.float32) for name in names}


def write_columns(
    path: Path,
    columns: dict[str, np.ndarray[Any, Any]],
    *,
    text: bool = False,
    byte_order: str = "<",
    more: tuple[plyfile.PlyElement, ...] = (),
    first: tuple[plyfile.PlyElement, ...] = (),
) -> Path:
    count = len(next(iter(columns.values())))
    table = np.empty(count, [(name, column.dtype.str) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    vertex = plyfile.PlyElement.describe(table, "vertex")
    plyfile.PlyData([*first, vertex, *more], text=text, byte_order="=" if text else byte_order).write(
        str(path)
    )
    return path


def read_columns(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    data = plyfile.PlyData.read(str(path))["vertex"].data
    return {name: np.asarray(data[name]) for name in data.dtype.names}
