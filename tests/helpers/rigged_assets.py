# SPDX-License-Identifier: GPL-3.0-or-later
"""Made-up rigged assets in the layout of `core/training/rigged.py`: striped tubes on chains of bones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from proxy_meshes import tube


def write_tube(path: Path, bones: int = 3, hue: float = 0.0, **changed) -> Path:
    """A tube along x, one unit per bone, weights blended over the joints; one control bone without weights."""
    verts, faces = tube(bones, 8 * bones + 1, 10, 0.15)
    wave = 0.5 + 0.4 * np.sin(5 * verts[faces][..., 0] + hue)
    heads = np.array([[-1, 0, 0], *[[k, 0, 0] for k in range(bones)]], np.float32)
    near = np.exp(-8 * np.maximum(np.abs(verts[:, 0, None] - (heads[1:, 0] + 0.5)) - 0.4, 0))
    near[near < 0.05] = 0
    near /= near.sum(1, keepdims=True)
    row, col = np.nonzero(near)
    rest = np.tile(np.eye(4, dtype=np.float32), (bones + 1, 1, 1))
    rest[:, :3, 3] = heads
    arrays = {
        "verts": verts.astype(np.float32),
        "faces": faces.astype(np.int32),
        "corner_rgb": (255 * np.stack([wave, 0.3 + 0 * wave, 1 - wave], -1)).astype(np.uint8),
        "w_row": row.astype(np.int32),
        "w_col": (col + 1).astype(np.int16),
        "w_val": near[row, col].astype(np.float32),
        "bone_names": np.array(["control", *[f"bone{k}" for k in range(bones)]]),
        "bone_parent": np.arange(-1, bones, dtype=np.int16),
        "bone_head": heads,
        "bone_tail": heads + np.float32([1, 0, 0]),
        "bone_rest": rest,
        "bone_used": np.array([False] + [True] * bones),
        **changed,
    }
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def write_collection(folder: Path, families: dict[str, int], licences: dict[str, str] | None = None) -> Path:
    """A folder with a catalogue: `families` by name with how many tubes each has."""
    (folder / "npz").mkdir(parents=True)
    entries = []
    for family, count in families.items():
        for k in range(count):
            name = f"{family}_{k}"
            write_tube(folder / "npz" / f"{name}.npz", bones=2 + k % 2, hue=k)
            licence = (licences or {}).get(family, "CC0")
            entries.append(
                {"name": name, "npz": f"npz/{name}.npz", "family": family, "license": licence, "author": "A. Tester"}
            )
    (folder / "catalog.json").write_text(json.dumps({"assets": entries}))
    return folder
