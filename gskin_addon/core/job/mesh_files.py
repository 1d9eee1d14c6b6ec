# SPDX-License-Identifier: GPL-3.0-or-later
"""Proxy meshes as files: arrays (.npz) of our own, or what trimesh reads. numpy only until it is needed."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, first_line
from ..files import disk_error, read_arrays, write_arrays
from ..rig.triangles import check_mesh

Array = NDArray[Any]

SUFFIXES = (".npz", ".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
"""Kinds of files that `read_mesh` takes. trimesh reads more, some by way of programs of others."""


def mesh_file(verts: Array, faces: Array) -> tuple[str, dict[str, Array]]:
    """Name and arrays of a mesh's file in a job's folder, for `prepare_job`; the name is the job's setting `mesh`.

    The name holds a digest of the mesh, so that a job with another mesh is another job.
    """
    arrays = {"verts": np.ascontiguousarray(verts, np.float64), "faces": np.ascontiguousarray(faces, np.int64)}
    digest = hashlib.blake2b(digest_size=8)
    for array in arrays.values():
        digest.update(array.tobytes())
    return f"mesh-{digest.hexdigest()}.npz", arrays


def mesh_name(verts: Array, faces: Array) -> str:
    """The name of `mesh_file`."""
    return mesh_file(verts, faces)[0]


def write_mesh(folder: Path, verts: Array, faces: Array) -> str:
    """Write a mesh (V, 3), (F, 3) into a job's folder; returns its `mesh_name`.

    Raises:
        GSkinError: the folder cannot be written.
    """
    name, arrays = mesh_file(verts, faces)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(error, folder) from error
    write_arrays(folder / name, arrays)
    return name


def read_mesh(path: Path) -> tuple[Array, Array]:
    """Vertices (V, 3) float64 and triangles (F, 3) int64, the numbers of the file as they are.

    .npz holds `verts` and `faces`; the other kinds of `SUFFIXES` are read by trimesh, all their parts together,
    doubled vertices merged, materials left alone.

    Raises:
        InputError: missing, of another kind, unreadable, or no mesh that can carry splats (see `check_mesh`).
    """
    if not path.is_file():
        raise InputError(f"The proxy mesh '{path}' does not exist; check its path.")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"'{path}' is no mesh file that is read here; give one of {', '.join(SUFFIXES)}.")
    if path.suffix.lower() == ".npz":
        try:
            verts, faces = read_arrays(path, ["verts", "faces"]).values()
        except (OSError, ValueError) as error:
            raise InputError(
                f"'{path}' does not hold a mesh ({error}); it needs the arrays verts and faces."
            ) from None
    else:
        verts, faces = _read_other(path)
    try:
        return check_mesh(verts, faces, f"'{path}'")
    except (TypeError, ValueError) as error:
        raise InputError(f"'{path}' does not hold a mesh of numbers ({first_line(error)}); export it again.") from None


def _read_other(path: Path) -> tuple[Array, Array]:
    try:
        import trimesh
    except ImportError:
        raise InputError(
            f"'{path}' needs trimesh to be read (pip install trimesh); or give an .npz with verts and faces."
        ) from None
    try:
        mesh = trimesh.load_scene(path, skip_materials=True).to_mesh()
    except Exception as error:  # every format has its own errors
        raise InputError(f"'{path}' cannot be read as a mesh ({error}); export it again.") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"'{path}' has no faces; give a mesh with a surface.")
    # Files store one vertex per corner normal or texture point; the surface itself is not torn there.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
