# SPDX-License-Identifier: GPL-3.0-or-later
"""A rigged mesh, flattened into one npz file, as splats with the artist's weights.

Arrays of a file, in a Z-up world: verts (V,3), faces (F,3), corner_rgb (F,3,3) uint8, sparse weights w_row, w_col,
w_val, bone_names, bone_parent, bone_head, bone_tail (B,3), bone_rest (B,4,4), bone_used (B,) and maybe anim_mats
(A,B,4,4).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from ..splats.from_mesh import sample_mesh

_ARRAYS = ("verts", "faces", "corner_rgb", "w_row", "w_col", "w_val", "bone_names", "bone_parent")
_RIG = ("bone_head", "bone_tail", "bone_rest", "bone_used")


@dataclass(frozen=True)
class Surface:
    """The mesh that splats were sampled from: verts (V, 3), faces (F, 3), and the triangle (N,) and barycentric
    coordinates (N, 3) of every splat."""

    verts: NDArray[np.float64]
    faces: NDArray[np.int64]
    face: NDArray[np.int64]
    bary: NDArray[np.float64]


@dataclass(frozen=True)
class RiggedSplats:
    """A cloud, its skeleton, and what an artist made of them.

    weights (N, B) float32, rows sum to 1; clip (F, B, 4, 4) deform transforms of an animation, or None; surface: the
    mesh that the splats were sampled from, where there was one.
    """

    name: str
    cloud: SplatCloud
    skeleton: Skeleton
    weights: NDArray[np.float32]
    clip: NDArray[np.float64] | None
    surface: Surface | None = None


def load_asset(path: Path, count: int, seed: int = 0, *, unused_bones: bool = False) -> RiggedSplats:
    """Read an asset and cover its surface with `count` splats.

    Bones that carry no weight (control bones) are left out unless `unused_bones`; their children hang on the next
    used ancestor.

    Raises:
        InputError: the file is missing, damaged, or has no surface or no weights.
    """
    data = _read(path)
    verts, faces = data["verts"].astype(np.float64), data["faces"]
    used = np.ones_like(data["bone_used"]) if unused_bones else data["bone_used"]
    order, parents = _used_bones(used, data["bone_parent"].astype(int))
    if not order:
        raise InputError(f"'{path}' has no bone that carries weights; leave the asset out.")
    cloud, face, bary = sample_mesh(
        verts, faces, data["corner_rgb"] / 255.0, count, np.random.default_rng(seed)
    )
    vertex_weights = np.zeros((len(verts), len(data["bone_used"])), np.float32)
    vertex_weights[data["w_row"], data["w_col"]] = data["w_val"]
    weights = np.einsum("nk,nkb->nb", bary, vertex_weights[:, order][faces[face]])
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    skeleton = Skeleton(
        names=tuple(str(name) for name in data["bone_names"][order]),
        parents=np.array(parents),
        heads=data["bone_head"][order].astype(np.float64),
        tails=data["bone_tail"][order].astype(np.float64),
        rest=data["bone_rest"][order].astype(np.float64),
    )
    clip = data["anim_mats"][:, order].astype(np.float64) if "anim_mats" in data else None
    surface = Surface(verts, faces.astype(np.int64), face, bary)
    return RiggedSplats(path.stem, cloud, skeleton, weights.astype(np.float32), clip, surface)


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        data = read_arrays(path)
    except (OSError, ValueError) as error:
        raise InputError(f"The asset '{path}' cannot be read ({error}); leave it out or get it again.") from None
    missing = [name for name in (*_ARRAYS, *_RIG) if name not in data]
    if missing:
        raise InputError(f"The asset '{path}' lacks the array {missing[0]}; leave it out or write it again.")
    return data


def _used_bones(used: NDArray[np.bool_], parent: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Used bones, parents first, and the position of each one's next used ancestor (-1 at a root)."""

    def ancestors(bone: int) -> list[int]:
        line = []
        while parent[bone] >= 0:
            bone = int(parent[bone])
            line.append(bone)
        return line

    order = sorted(np.flatnonzero(used).tolist(), key=lambda bone: len(ancestors(bone)))
    position = {bone: i for i, bone in enumerate(order)}
    return order, [next((position[a] for a in ancestors(b) if a in position), -1) for b in order]
