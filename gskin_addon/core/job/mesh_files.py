# SPDX-License-Identifier: GPL-3.0-or-later
"""Proxy meshes as files: arrays (.npz) of our own, or whatever trimesh reads. numpy only until it is needed."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import disk_error, write_arrays
from ..rig.triangles import check_mesh

Array = NDArray[Any]


def mesh_name(verts: Array, faces: Array) -> str:
    """The name of a mesh's file in a job's folder, the job's setting `mesh`.

    It holds a digest of the mesh, so that a job with another mesh is another job.
    """
    digest = hashlib.blake2b(digest_size=8)
    for array in _arrays(verts, faces).values():
        digest.update(array.tobytes())
    return f"mesh-{digest.hexdigest()}.npz"


def write_mesh(folder: Path, verts: Array, faces: Array) -> str:
    """Write a mesh (V, 3), (F, 3) into a job's folder; returns its `mesh_name`.

    Raises:
        GSkinError: the folder cannot be written.
    """
    name = mesh_name(verts, faces)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(error, folder) from error
    write_arrays(folder / name, _arrays(verts, faces))
    return name


def read_mesh(path: Path) -> tuple[Array, Array]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64, the numbers of the file as they are.

    .npz holds `verts` and `faces`; other files (.obj, .ply, .glb, .stl, ...) are read by trimesh, all their
    parts together, doubled vertices merged.

    Raises:
        InputError: missing, unreadable, or no mesh that can carry splats (see `check_mesh`).
    """
    if not path.is_file():
        raise InputError(f"The proxy mesh '{path}' does not exist; check its path.")
    if path.suffix.lower() == ".npz":
        try:
            with np.load(path, allow_pickle=False) as file:
                verts, faces = file["verts"], file["faces"]
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise InputError(
                f"'{path}' does not hold a mesh ({error}); it needs the arrays verts and faces."
            ) from None
    else:
        verts, faces = _read_other(path)
    return check_mesh(verts, faces, f"'{path}'")


def _arrays(verts: Array, faces: Array) -> dict[str, Array]:
    return {"verts": np.ascontiguousarray(verts, np.float64), "faces": np.ascontiguousarray(faces, np.int64)}


def _read_other(path: Path) -> tuple[Array, Array]:
    try:
        import trimesh
    except ImportError:
        raise InputError(
            f"'{path}' needs trimesh to be read (pip install trimesh); or give an .npz with verts and faces."
        ) from None
    try:
        mesh = trimesh.load_scene(path).to_mesh()
    except Exception as error:  # every format has its own errors
        raise InputError(f"'{path}' cannot be read as a mesh ({error}); export it again.") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"'{path}' has no faces; give a mesh with a surface.")
    # Files store one vertex per corner normal or texture point; the surface itself is not torn there.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
