# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that `gskin weights` takes weights from or writes them for: skinned meshes, rigged splats, plain meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job.skinned_files import read_skinned, read_surface
from ..core.rig.gltf_skin import read_gltf_skin
from ..core.rig.rignet_file import write_rignet
from ..core.rig.skeleton import Skeleton
from ..core.rig.weights_file import write_weights_file
from ..core.skinning.edits.assign import limit
from ..core.skinning.transfer.transfer import Shape, transfer
from ..core.splats import formats
from .console import print_message

if TYPE_CHECKING:
    import bpy

Array = NDArray[Any]

SOURCES = ("from_mesh", "from_splats")
"""Options whose value is such a file."""


@dataclass(frozen=True, eq=False)
class Source:
    """label: what messages call it; shape in world space, z up, at rest; weights (M, B) of bones, B names."""

    label: str
    shape: Shape
    weights: Array
    bones: tuple[str, ...]

    def for_bones(self, bones: list[str]) -> tuple[Array, str]:
        """Weights (M, C) for `bones`, C names, and a note about weights of others, which are left out.

        Raises InputError: none of the bones has weights here.
        """
        place = {name: column for column, name in enumerate(self.bones)}
        out = np.zeros((len(self.weights), len(bones)), np.float32)
        for column, name in enumerate(bones):
            if name in place:
                out[:, column] = self.weights[:, place[name]]
        if not out.any():
            raise InputError(
                f"{self.label} has no weights for bones of the armature, but for {_listed(self.bones)}; rename them."
            )
        known = set(bones)
        others = [name for name in self.bones if name not in known and self.weights[:, place[name]].any()]
        return out, f"weights of {_listed(others)} were left out, which are no deform bones" if others else ""


def read_source(option: str, path: Path, up: str | None) -> Source:
    """The mesh or the splats that `path` holds with their weights; a .blend is opened for it.

    Raises InputError: of another kind, damaged, without weights.
    """
    label = f"'{path}'"
    if option == "from_mesh":
        mesh = read_skinned(path, up)
        return Source(label, Shape.of_mesh(mesh.verts, mesh.faces), mesh.weights, mesh.bones)
    if path.suffix.lower() == ".glb":
        skin = read_gltf_skin(path, splats=True)
        cloud = formats.read_splats(path).cloud
        if cloud.count != len(skin.verts):
            raise InputError(f"{label} has splats with and without weights; export the rigged ones alone.")
        cloud = replace(cloud, means=skin.verts.astype(np.float32))
        return Source(label, Shape.of_splats(cloud), skin.weights, skin.bones)
    if path.suffix.lower() != ".blend":
        raise InputError(f"{label} is neither .blend nor .glb; give rigged splats as `gskin rig` wrote them.")
    from ..scene import rig_files
    from ..scene.armature import deform_bone_names
    from ..scene.proxy_object import followed_armature
    from ..scene.seams import read_seams
    from ..scene.splat_object import read_cloud
    from ..scene.weights import read_weights

    rig_files.open_blend(path)
    obj = rig_files.find_splats(path, None)
    armature = followed_armature(obj)
    if armature is None:
        raise InputError(f"'{obj.name}' in {label} follows no armature, so it has no weights to give.")
    weights, bones = read_weights(obj, deform_bone_names(armature))
    return Source(label, Shape.of_splats(read_cloud(obj), read_seams(obj)), weights, tuple(bones))


def write_for_mesh(
    path: Path,
    out: Path,
    obj: bpy.types.Object,
    shape: Shape,
    skeleton: Skeleton,
    up: str | None,
    how: dict[str, Any],
) -> None:
    """Write weights of `obj`, of that shape, for the vertices of the mesh in `path`, at most four bones each."""
    from ..scene.bone_frames import armature_of
    from ..scene.mesh_export import export_skinned_mesh
    from ..scene.weights import read_weights

    verts, faces = read_surface(path, up)
    weights, _ = read_weights(obj, skeleton.names)
    result = transfer(shape, weights, Shape.of_mesh(verts, faces), **how)
    few = limit(result.weights, 4)
    if out.suffix.lower() == ".txt":
        write_rignet(out, few, skeleton)
    elif out.suffix.lower() == ".glb":
        export_skinned_mesh(out, verts, faces, armature_of(obj), few, skeleton.names)
    else:
        write_weights_file(out, few, skeleton)
    filled = int((~result.taken).sum())
    words = f"; {filled:,} had no match and were filled in from around them" if filled else ""
    print_message(f"--to-mesh: weights for {len(verts):,} vertices of '{path}'{words}.")


def _listed(names: list[str] | tuple[str, ...]) -> str:
    return ", ".join(f"'{name}'" for name in names[:4]) + (", ..." if len(names) > 4 else "")
