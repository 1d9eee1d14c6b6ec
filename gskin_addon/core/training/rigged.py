# SPDX-License-Identifier: GPL-3.0-or-later
"""A rigged mesh, flattened into one npz file, and splats on it with the artist's weights.

Arrays of a file, in a Z-up world: verts (V,3), faces (F,3), corner_rgb (F,3,3) uint8, sparse weights w_row, w_col,
w_val, bone_parent (B,), bone_head, bone_tail (B,3); where known bone_names (B,), bone_rest (B,4,4), bone_used (B,),
anim_mats (A,B,4,4) and the textures of `textures.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..rig.skeleton import Skeleton, parents_first
from ..splats.cloud import SplatCloud
from ..splats.from_mesh import sample_mesh
from ..splats.sh import SH_C0
from .textures import Textures, read_textures

_NEEDED = ("verts", "faces", "corner_rgb", "w_row", "w_col", "w_val", "bone_parent", "bone_head", "bone_tail")


@dataclass(frozen=True)
class RiggedMesh:
    """A rigged mesh: verts (V, 3), faces (F, 3), corner_rgb (F, 3, 3) in [0, 1], weights (V, B) float32; used
    (B,): the bones that carry weight; clip (A, B, 4, 4): deform transforms of an animation, and textures, where there
    are such."""

    verts: NDArray[Any]
    faces: NDArray[Any]
    corner_rgb: NDArray[Any]
    weights: NDArray[Any]
    skeleton: Skeleton
    used: NDArray[Any]
    clip: NDArray[Any] | None = None
    textures: Textures | None = None


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


def read_rigged_mesh(path: Path) -> RiggedMesh:
    """Read an asset; its bones with parents first, else in the file's order.

    Raises:
        InputError: the file is missing, damaged, or not of the layout above.
    """
    data = _arrays(path)
    try:
        verts, parents = data["verts"].astype(np.float64), data["bone_parent"].astype(int)
        count = len(parents)
        weights = np.zeros((len(verts), count), np.float32)
        weights[data["w_row"], data["w_col"]] = data["w_val"]
        names = tuple(str(name) for name in data.get("bone_names", np.arange(count)))
        skeleton = Skeleton(names, parents, data["bone_head"], data["bone_tail"], data.get("bone_rest"))  # type: ignore[arg-type]
        used = data["bone_used"].astype(bool) if "bone_used" in data else weights.max(0) > 0.01
        order = parents_first(parents)
        mesh = RiggedMesh(
            verts,
            data["faces"],
            data["corner_rgb"] / 255.0,
            weights,
            skeleton,
            used,
            data.get("anim_mats"),
            read_textures(data, len(data["faces"])),
        )
        return with_bones(mesh, order)
    except (ValueError, IndexError) as error:
        raise InputError(f"The asset '{path}' is damaged ({error}); leave it out or write it again.") from error


def with_bones(mesh: RiggedMesh, order: NDArray[Any]) -> RiggedMesh:
    """The mesh with the bones `order` (C,) of its own, parents first; a bone hangs on its next kept ancestor."""
    place = np.full(mesh.skeleton.count, -1)
    place[order] = np.arange(len(order))
    parents = []
    for bone in order:
        parent = int(mesh.skeleton.parents[bone])
        while parent >= 0 and place[parent] < 0:
            parent = int(mesh.skeleton.parents[parent])
        parents.append(int(place[parent]) if parent >= 0 else -1)
    old = mesh.skeleton
    names = tuple(old.names[bone] for bone in order)
    skeleton = Skeleton(names, np.array(parents, int), old.heads[order], old.tails[order], old.rest[order])
    clip = None if mesh.clip is None else mesh.clip[:, order]
    return replace(mesh, weights=mesh.weights[:, order], skeleton=skeleton, used=mesh.used[order], clip=clip)


def load_asset(path: Path, count: int, seed: int = 0, *, unused_bones: bool = False) -> RiggedSplats:
    """Read an asset and cover its surface with `count` splats; its bones by their depth in the tree.

    Bones that carry no weight (control bones) are left out unless `unused_bones`; their children hang on the next
    used ancestor.

    Raises:
        InputError: the file is missing, damaged, or has no surface or no weights.
    """
    mesh = read_rigged_mesh(path)
    chosen = np.ones_like(mesh.used) if unused_bones else mesh.used
    if not chosen.any():
        raise InputError(f"'{path}' has no bone that carries weights; leave the asset out.")
    order = np.argsort(_depths(mesh.skeleton), kind="stable")
    mesh = with_bones(mesh, order[chosen[order]])
    cloud, face, bary = sample_mesh(mesh.verts, mesh.faces, mesh.corner_rgb, count, np.random.default_rng(seed))
    cloud = textured(cloud, mesh, face, bary)
    weights = np.einsum("nk,nkb->nb", bary, mesh.weights[mesh.faces[face]])
    weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)
    clip = None if mesh.clip is None else mesh.clip.astype(np.float64)
    surface = Surface(mesh.verts, mesh.faces.astype(np.int64), face, bary)
    return RiggedSplats(path.stem, cloud, mesh.skeleton, weights.astype(np.float32), clip, surface)


def textured(cloud: SplatCloud, mesh: RiggedMesh, face: NDArray[Any], bary: NDArray[Any]) -> SplatCloud:
    """The cloud (N splats, SH degree 0) with the textures' colours where its splats have such.

    face (N,), bary (N, 3): where on the mesh the splats lie.
    """
    if mesh.textures is None:
        return cloud
    has, colors = mesh.textures.colors(face, bary)
    sh = np.where(has[:, None, None], ((colors - 0.5) / SH_C0)[:, None, :], cloud.sh)
    return replace(cloud, sh=sh.astype(np.float32))


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        data = read_arrays(path)
    except (OSError, ValueError) as error:
        raise InputError(f"The asset '{path}' cannot be read ({error}); leave it out or get it again.") from None
    missing = [name for name in _NEEDED if name not in data]
    if missing:
        raise InputError(f"The asset '{path}' lacks the array {missing[0]}; leave it out or write it again.")
    return data


def _depths(skeleton: Skeleton) -> NDArray[np.int64]:
    """(B,) how many ancestors each bone has."""
    depths = np.zeros(skeleton.count, np.int64)
    for bone, parent in enumerate(skeleton.parents):
        if parent >= 0:
            depths[bone] = depths[parent] + 1
    return depths
