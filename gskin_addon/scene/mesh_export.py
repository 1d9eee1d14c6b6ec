# SPDX-License-Identifier: GPL-3.0-or-later
"""A skinned mesh with its armature as .glb, by Blender's exporter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from numpy.typing import NDArray

from ..core.errors import GSkinError, first_line
from ..core.files import replaced
from .proxy_object import bind_proxy, create_mesh_object
from .visibility import shown

Array = NDArray[Any]


def export_skinned_mesh(
    path: Path, verts: Array, faces: Array, armature: bpy.types.Object, weights: Array, bones: Sequence[str]
) -> None:
    """Write verts (V, 3), world, and faces (F, 3) that follow `armature` by weights (V, B) of `bones`.

    The scene is left as it was but for the selection. Raises GSkinError: the exporter fails, or the disk does.
    """
    mesh = create_mesh_object(path.stem, verts, faces)
    try:
        bind_proxy(mesh, armature, weights, bones)
        with replaced(path, ".glb") as temporary, shown([mesh, armature], select=True):
            for obj in bpy.context.view_layer.objects:
                obj.select_set(obj in (mesh, armature))
            bpy.ops.export_scene.gltf(
                filepath=str(temporary),
                check_existing=False,
                export_format="GLB",
                use_selection=True,
                export_skins=True,
                export_influence_nb=4,
                export_animations=False,
            )
    except RuntimeError as error:
        raise GSkinError(f"'{path}': Blender's glTF exporter failed ({first_line(error)}).") from error
    finally:
        data: Any = mesh.data
        bpy.data.objects.remove(mesh)
        bpy.data.meshes.remove(data)
