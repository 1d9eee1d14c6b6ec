# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes with skin weights, and meshes that are to get some, as files: .glb, .npz, .obj and RigNet. numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..rig.gltf_skin import Skinned, read_gltf_skin
from ..rig.obj_file import read_obj
from ..rig.rignet_file import file_names, read_rignet
from ..rig.weights_file import WeightsFile, read_weights_file
from ..splats.axes import up_rotation

Array = NDArray[Any]

SKINNED = (".glb", ".gltf", ".npz", ".txt")
"""Kinds of files that `read_skinned` takes."""

_SPARSE = ("w_row", "w_col", "w_val", "bone_names")


def read_skinned(path: Path, up: str | None = None) -> Skinned:
    """A mesh with weights, z up.

    .glb and .gltf hold all of it. .npz: verts (V, 3), faces (F, 3), bones (B,) names and weights (V, B), or the rows,
    columns and values w_row, w_col, w_val (K,) with bone_names. .txt: RigNet's rig, with the mesh as .obj of the same
    name beside it. up: the up axis of .npz (z where left out) and .obj (y).

    Raises InputError: missing, of another kind, damaged, or weights of other vertices than the mesh has.
    """
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return read_gltf_skin(path)
    if suffix == ".npz":
        return _turned(_read_npz(path), up or "z")
    if suffix == ".txt":
        rig, (verts, faces) = read_rignet(path), read_obj(path.with_suffix(".obj"))
        return _turned(_fitting(path, verts, faces, rig.weights, rig.bones), up or "y")
    raise InputError(f"'{path}' is no skinned mesh that is read here; give one of {', '.join(SKINNED)}.")


def read_surface(path: Path, up: str | None = None) -> tuple[Array, Array]:
    """Vertices (V, 3), z up, in the file's order, and triangles (F, 3) of an .obj, .npz (verts, faces) or skinned .glb.

    Raises InputError as `read_skinned`.
    """
    suffix = path.suffix.lower()
    if suffix == ".obj":
        verts, faces = read_obj(path)
        return verts @ up_rotation(up or "y").T, faces
    if suffix == ".npz":
        verts, faces = _mesh_arrays(path, _arrays(path, ("verts", "faces")))
        return verts @ up_rotation(up or "z").T, faces
    if suffix in (".glb", ".gltf"):
        mesh = read_gltf_skin(path)
        return mesh.verts, mesh.faces
    raise InputError(f"'{path}' is no mesh that can get weights here; give an .obj, an .npz or a skinned .glb.")


def _read_npz(path: Path) -> Skinned:
    arrays = _arrays(path, ("verts", "faces"), ("weights", "bones", *_SPARSE))
    verts, faces = _mesh_arrays(path, arrays)
    try:
        if "weights" in arrays:
            weights, bones = np.asarray(arrays["weights"], np.float32), arrays["bones"]
        else:
            bones = arrays["bone_names"]
            weights = np.zeros((len(verts), len(bones)), np.float32)
            weights[arrays["w_row"], arrays["w_col"]] = arrays["w_val"]
    except KeyError as error:
        raise InputError(f"'{path}' lacks the array {error}; it needs weights and bones.") from None
    except (IndexError, ValueError, TypeError) as error:
        raise InputError(f"'{path}' has damaged weights ({error}); write it again.") from None
    return _fitting(path, verts, faces, weights, tuple(str(name) for name in bones))


def _arrays(path: Path, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Array]:
    try:
        return read_arrays(path, names, optional)
    except FileNotFoundError:
        raise InputError(f"'{path}' does not exist; check its path.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' does not hold a mesh ({error}); it needs the arrays verts and faces.") from None


def _mesh_arrays(path: Path, arrays: dict[str, Array]) -> tuple[Array, Array]:
    verts, faces = arrays["verts"], arrays["faces"]
    fits = verts.ndim == 2 and verts.shape[1:] == (3,) and verts.dtype.kind == "f" and bool(np.isfinite(verts).all())
    fits &= faces.ndim == 2 and faces.shape[1:] == (3,) and faces.dtype.kind in "iu" and len(faces) > 0
    if not fits or faces.min() < 0 or faces.max() >= len(verts):
        raise InputError(f"'{path}' does not hold a mesh of triangles (verts, faces); write it again.")
    return verts.astype(np.float64), faces.astype(np.int64)


def _fitting(path: Path, verts: Array, faces: Array, weights: Array, bones: tuple[str, ...]) -> Skinned:
    if weights.shape != (len(verts), len(bones)):
        raise InputError(
            f"'{path}' has weights {weights.shape} for {len(verts):,} vertices and {len(bones)} bones; give those of "
            "this mesh."
        )
    if not np.isfinite(weights).all() or (weights < 0).any():
        raise InputError(f"'{path}' has weights that are negative or not finite; write it again.")
    return Skinned(verts, faces, weights, bones)


def _turned(mesh: Skinned, up: str) -> Skinned:
    return Skinned(mesh.verts @ up_rotation(up).T, mesh.faces, mesh.weights, mesh.bones)


def read_weights(path: Path, bones: Sequence[str]) -> WeightsFile:
    """Weights of a file of ours (.npz) or RigNet's (.txt), for an armature with `bones`.

    RigNet's names have no spaces: those of the bones that they stand for come instead. Its joints that move nothing are
    left out where the armature has no such bone.

    Raises InputError as `read_weights_file` and `read_rignet` do.
    """
    if path.suffix.lower() != ".txt":
        return read_weights_file(path)
    rig = read_rignet(path)
    known = dict(zip(file_names(list(bones)), bones, strict=True))
    kept = [column for column, name in enumerate(rig.bones) if name in known or rig.weights[:, column].any()]
    place = {column: number for number, column in enumerate(kept)}
    parents = []
    for column in kept:
        parent = int(rig.parents[column])
        while parent >= 0 and parent not in place:
            parent = int(rig.parents[parent])
        parents.append(place.get(parent, -1))
    names = tuple(known.get(rig.bones[column], rig.bones[column]) for column in kept)
    return WeightsFile(rig.weights[:, kept], names, rig.heads[kept], rig.tails[kept], np.array(parents, np.int64))
