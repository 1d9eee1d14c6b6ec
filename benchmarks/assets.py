# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged meshes as splats with the artist's weights: the ground truth of the benchmarks and tests."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.from_mesh import sample_mesh

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).resolve().parents[2] / "shared" / "assets"))


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


def load_asset(
    name: str, count: int, seed: int = 0, folder: Path = ASSETS, *, unused_bones: bool = False
) -> RiggedSplats:
    """Read `npz/<name>.npz` of the shared assets and cover its surface with `count` splats.

    Bones that carry no weight (control bones) are left out unless `unused_bones`; their children hang on the next
    used ancestor.

    Raises:
        FileNotFoundError: the asset is not on this machine.
    """
    data = np.load(folder / "npz" / f"{name}.npz")
    verts, faces = data["verts"].astype(np.float64), data["faces"]
    cloud, face, bary = sample_mesh(
        verts, faces, data["corner_rgb"] / 255.0, count, np.random.default_rng(seed)
    )
    order, parents = _used_bones(
        np.ones_like(data["bone_used"]) if unused_bones else data["bone_used"], data["bone_parent"].astype(int)
    )
    heads, tails = data["bone_head"][order].astype(np.float64), data["bone_tail"][order].astype(np.float64)
    vertex_weights = np.zeros((len(verts), len(data["bone_used"])), np.float32)
    vertex_weights[data["w_row"], data["w_col"]] = data["w_val"]
    weights = np.einsum("nk,nkb->nb", bary, vertex_weights[faces[face]][:, :, order])
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    return RiggedSplats(
        name,
        cloud,
        Skeleton(
            names=tuple(str(n) for n in data["bone_names"][order]),
            parents=np.array(parents),
            heads=heads,
            tails=tails,
            rest=data["bone_rest"][order].astype(np.float64),
        ),
        weights.astype(np.float32),
        data["anim_mats"][:, order].astype(np.float64) if "anim_mats" in data else None,
        Surface(verts, faces.astype(np.int64), face, bary),
    )


def _used_bones(used: NDArray[np.bool_], parent: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Used bones, parents first, and the position of each one's next used ancestor (-1 at a root)."""

    def ancestors(bone: int) -> list[int]:
        line = []
        while parent[bone] >= 0:
            bone = int(parent[bone])
            line.append(bone)
        return line

    order = sorted(np.flatnonzero(used).tolist(), key=lambda b: len(ancestors(b)))
    position = {bone: i for i, bone in enumerate(order)}
    return order, [next((position[a] for a in ancestors(b) if a in position), -1) for b in order]
