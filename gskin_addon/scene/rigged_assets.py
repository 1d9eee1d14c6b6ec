# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged models of the present scene as the arrays that training reads (`core/training/rigged.py`)."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .liveliest_clip import liveliest_clip
from .rig_files import empty_scene, import_objects, open_blend
from .rigged_colors import PartColors, color_arrays, read_colors

Array = NDArray[Any]

SUFFIXES = (".glb", ".gltf", ".vrm", ".fbx", ".blend")
MOST_FACES = 2_000_000


@dataclass
class RiggedAsset:
    """arrays: of the npz; notes: what was left out or guessed, in a few words each; armature: the name of its own."""

    arrays: dict[str, Array]
    armature: str
    notes: list[str] = field(default_factory=list)


def import_rigged(path: Path) -> RiggedAsset:
    """The rigged model of a glTF, VRM, FBX or .blend file; the present scene is left for an empty one.

    Nothing in the file is run: a .blend is opened without its scripts. Raises InputError: unreadable, no armature, no
    mesh that it moves, no weights.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"'{path}' is no rigged model; give a {', '.join(SUFFIXES)} file.")
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path.")
    empty_scene()
    if path.suffix.lower() == ".blend":
        open_blend(path)
    elif path.suffix.lower() == ".vrm":
        # A VRM is a glTF in one file; Blender's importer goes by the ending.
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / f"{path.stem}.glb"
            shutil.copyfile(path, copy)
            try:
                import_objects(copy)
            except InputError as error:
                raise InputError(str(error).replace(str(copy), str(path))) from error
    else:
        import_objects(path)
    return read_rigged(path)


def read_rigged(path: Path) -> RiggedAsset:
    """The rigged model of the scene; `path` is named in errors. Raises InputError as `import_rigged` does."""
    layer: Any = bpy.context.view_layer
    armatures = {obj: _bound_meshes(obj) for obj in layer.objects if obj.type == "ARMATURE"}
    if not armatures:
        raise InputError(f"'{path}' has no armature; leave the file out, or rig it.")
    sizes = {obj: sum(len(mesh.data.vertices) for mesh in meshes) for obj, meshes in armatures.items()}
    armature = max(sizes, key=lambda obj: sizes[obj])
    if not sizes[armature]:
        raise InputError(f"'{path}' has an armature but no mesh that follows it; leave the file out, or bind one.")
    notes = []
    others = [obj.name for obj, size in sizes.items() if obj != armature and size]
    if others:
        notes.append(f"only '{armature.name}' was taken, not {', '.join(others)}")
    for obj in armatures:
        obj.data.pose_position = "REST"
    for mesh in armatures[armature]:
        _without_shape_keys(mesh)
    layer.update()
    parts = [_read_part(obj, armature, notes) for obj in armatures[armature]]
    arrays = _joined(parts, armature, path, notes)
    clip = liveliest_clip(armature)
    if clip is not None:
        arrays |= {"anim_mats": clip[1].astype(np.float32), "anim_name": np.array(clip[0])}
    return RiggedAsset(arrays, armature.name, notes)


def _bound_meshes(armature: bpy.types.Object) -> list[bpy.types.Object]:
    """Visible meshes that the armature moves, by a modifier or as their parent."""
    found = []
    for obj in bpy.context.view_layer.objects:
        if obj.type != "MESH" or obj.hide_render or not obj.data.polygons:
            continue
        if _is_skinned(obj, armature) or _carrier(obj, armature):
            found.append(obj)
    return found


def _without_shape_keys(obj: bpy.types.Object) -> None:
    """The basis, whatever expression the file shows."""
    keys: Any = getattr(obj.data, "shape_keys", None)
    for key in keys.key_blocks[1:] if keys is not None else ():
        key.mute = True


def _is_skinned(obj: bpy.types.Object, armature: bpy.types.Object) -> bool:
    """Whether vertex groups of `obj` follow the armature."""
    modifiers: list[Any] = [m for m in obj.modifiers if m.type == "ARMATURE" and m.show_viewport]
    by_parent = obj.parent == armature and obj.parent_type == "ARMATURE"
    return by_parent or any(modifier.object == armature for modifier in modifiers)


def _carrier(obj: bpy.types.Object, armature: bpy.types.Object) -> str:
    """The bone that `obj` hangs on, through whatever parents; empty for none."""
    while obj.parent is not None:
        if obj.parent == armature and obj.parent_type == "BONE":
            return obj.parent_bone
        obj = obj.parent
    return ""


@dataclass
class _Part:
    """One mesh: verts (V, 3) in the world, faces (F, 3), weights as vertex, bone and value (M,) each, and colours."""

    verts: Array
    faces: Array
    weights: tuple[Array, Array, Array]
    colors: PartColors


def _read_part(obj: bpy.types.Object, armature: bpy.types.Object, notes: list[str]) -> _Part:
    graph = bpy.context.evaluated_depsgraph_get()
    evaluated: Any = obj.evaluated_get(graph)
    mesh: Any = evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=graph)
    try:
        mesh.calc_loop_triangles()
        count, triangles = len(mesh.vertices), len(mesh.loop_triangles)
        if triangles > MOST_FACES:
            raise InputError(f"'{obj.name}' has {triangles:,} triangles; decimate it below {MOST_FACES:,}.")
        verts = np.empty(3 * count, np.float32)
        mesh.vertices.foreach_get("co", verts)
        matrix = np.array(evaluated.matrix_world, np.float64)
        verts = verts.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        faces, loops, material = (np.empty(n * triangles, np.int32) for n in (3, 3, 1))
        mesh.loop_triangles.foreach_get("vertices", faces)
        mesh.loop_triangles.foreach_get("loops", loops)
        mesh.loop_triangles.foreach_get("material_index", material)
        faces, loops = faces.reshape(-1, 3), loops.reshape(-1, 3)
        if np.linalg.det(matrix[:3, :3]) < 0:  # a mirrored object is drawn with its triangles turned round
            faces, loops = faces[:, ::-1], loops[:, ::-1]
        colors = read_colors(obj, mesh, faces, loops, material)
        weights = _weights(obj, mesh, armature, notes)
    finally:
        evaluated.to_mesh_clear()
    return _Part(verts, faces, weights, colors)


def _weights(
    obj: bpy.types.Object, mesh: Any, armature: bpy.types.Object, notes: list[str]
) -> tuple[Array, Array, Array]:
    """Vertex, bone and value of all weights, not normalised."""
    bones: Any = armature.data.bones
    number = {bone.name: k for k, bone in enumerate(bones)}
    count = len(mesh.vertices)
    carrier = _carrier(obj, armature)
    if carrier in number and not _is_skinned(obj, armature):
        return np.arange(count), np.full(count, number[carrier]), np.ones(count)
    column = {g.index: number[g.name] for g in obj.vertex_groups if g.name in number and bones[g.name].use_deform}
    rows, columns, values = [], [], []
    for vertex in mesh.vertices:
        for element in vertex.groups:
            bone = column.get(element.group)
            if bone is not None and element.weight > 0:
                rows.append(vertex.index)
                columns.append(bone)
                values.append(element.weight)
    if not rows:
        notes.append(f"'{obj.name}' has no weights and was left out")
    return np.array(rows, int), np.array(columns, int), np.array(values, float)


def _joined(parts: list[_Part], armature: bpy.types.Object, path: Path, notes: list[str]) -> dict[str, Array]:
    parts = [part for part in parts if len(part.weights[0]) and len(part.faces)]
    if not parts:
        raise InputError(f"'{path}' has no vertex with a weight for its armature's bones; leave the file out.")
    starts = np.cumsum([0, *(len(part.verts) for part in parts)])
    verts = np.concatenate([part.verts for part in parts])
    if not np.isfinite(verts).all():
        raise InputError(f"'{path}' has vertices that are not finite numbers; clean it up and export it again.")
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    row = np.concatenate([part.weights[0] + start for part, start in zip(parts, starts, strict=False)])
    col, val = (np.concatenate([part.weights[k] for part in parts]) for k in (1, 2))
    bones = _bones(armature)
    row, col, val = _normalised(row, col, val, len(verts), bones["bone_parent"], notes)
    used = np.zeros(len(bones["bone_parent"]), bool)
    used[col[val > 0.01]] = True
    part_id = np.repeat(np.arange(len(parts)), np.diff(starts))
    return {
        "verts": verts.astype(np.float32),
        "faces": faces.astype(np.int32),
        "w_row": row.astype(np.int32),
        "w_col": col.astype(np.int16),
        "w_val": val.astype(np.float32),
        **bones,
        "bone_used": used,
        "part_id": part_id.astype(np.int16),
        **color_arrays([part.colors for part in parts], notes),
    }


def _normalised(
    row: Array, col: Array, val: Array, count: int, parents: Array, notes: list[str]
) -> tuple[Array, Array, Array]:
    """Weights of each vertex that sum to 1, sorted; vertices without any get the root of the bones that have most."""
    total = np.bincount(row, val, count)
    lost = np.flatnonzero(total <= 0)
    if len(lost):
        heavy = int(np.bincount(col, val).argmax())
        while parents[heavy] >= 0:
            heavy = int(parents[heavy])
        notes.append(f"{len(lost)} vertices without weights follow the root bone")
        row, col = np.concatenate([row, lost]), np.concatenate([col, np.full(len(lost), heavy)])
        val, total = np.concatenate([val, np.ones(len(lost))]), np.bincount(np.append(row, lost), minlength=count)
        total = np.bincount(row, val, count)
    order = np.lexsort((col, row))
    return row[order], col[order], (val / total[row])[order]


def _bones(armature: bpy.types.Object) -> dict[str, Array]:
    bones: list[Any] = list(armature.data.bones)
    number = {bone.name: k for k, bone in enumerate(bones)}
    world = np.array(armature.matrix_world, np.float64)

    def there(points: list[Any]) -> Array:
        return (np.array(points, np.float64).reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]).astype(np.float32)

    rest = [world @ np.array(bone.matrix_local, np.float64) for bone in bones]
    return {
        "bone_names": np.array([bone.name for bone in bones], dtype=np.str_),
        "bone_parent": np.array([number[b.parent.name] if b.parent else -1 for b in bones], np.int16),
        "bone_head": there([bone.head_local for bone in bones]),
        "bone_tail": there([bone.tail_local for bone in bones]),
        "bone_rest": np.array(rest, np.float32),
    }
