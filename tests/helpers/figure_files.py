# SPDX-License-Identifier: GPL-3.0-or-later
"""A standing figure as raw .ply columns, and its rig: the kind of /cases in shared material, made here.

Trunk of a box from 0 to 1.3 up z, two arms along x at 1.0; bones spine, head, arm.L, hand.L, arm.R, hand.R.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pretend

CASES = Path(os.environ.get("GSKIN_CASES", Path(__file__).resolve().parents[3] / "shared" / "cases"))
"""Small inputs that went wrong for somebody; tests make the same kinds themselves where this folder is not there."""

BONES = (
    ("spine", (0, 0, 0), (0, 0, 0.95)),
    ("head", (0, 0, 0.95), (0, 0, 1.3)),
    ("arm.L", (0.1, 0, 1.0), (0.45, 0, 1.0)),
    ("hand.L", (0.45, 0, 1.0), (0.8, 0, 1.0)),
    ("arm.R", (-0.1, 0, 1.0), (-0.45, 0, 1.0)),
    ("hand.R", (-0.45, 0, 1.0), (-0.8, 0, 1.0)),
)

Columns = dict[str, np.ndarray[Any, Any]]


def figure(count: int = 900, seed: int = 0) -> Columns:
    """Raw columns of `count` splats on the figure, float32, Blender's axes."""
    rng = np.random.default_rng(seed)
    trunk = count // 2
    x = np.concatenate([rng.uniform(-0.2, 0.2, trunk), rng.uniform(0.2, 0.8, count - trunk)])
    x[trunk:] *= np.where(np.arange(count - trunk) % 2, 1, -1)
    z = np.concatenate([rng.uniform(0, 1.3, trunk), rng.uniform(0.92, 1.08, count - trunk)])
    y = rng.uniform(-0.15, 0.15, count)
    columns = {"x": x, "y": y, "z": z}
    columns |= {f"f_dc_{k}": rng.normal(size=count) for k in range(3)}
    columns["opacity"] = np.full(count, 2.0)
    columns |= {f"scale_{k}": rng.normal(-4.5, 0.3, count) for k in range(3)}
    columns |= {f"rot_{k}": rng.normal(size=count) for k in range(4)}
    return {name: column.astype(np.float32) for name, column in columns.items()}


def rig_file(path: Path, *, scale: float = 1.0, location: tuple[float, float, float] = (0, 0, 0)) -> Path:
    """A .blend with the figure's armature, its bones (not its object) scaled, the object at `location`."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bones = [(name, *(tuple(scale * v for v in end) for end in ends)) for name, *ends in BONES]
    pretend.add_armature(bones).location = location
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    return path
