# SPDX-License-Identifier: GPL-3.0-or-later
"""What the sample character needs Blender for: armature, fusing, bone heat, baked light, keyframes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from gskin_addon.scene.posing import turn_bones

from .shapes import Mesh
from .skeleton import Turns, bones

Array = NDArray[np.float64]


def empty_scene() -> None:
    """Start from nothing, so that the result depends on no start-up file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def make_armature(name: str) -> Any:
    """The armature object with its 29 deform bones below a `root` that does not deform."""
    armature = bpy.data.armatures.new(name)
    rig = bpy.data.objects.new(name, armature)
    bpy.context.scene.collection.objects.link(rig)
    _only(rig)
    bpy.ops.object.mode_set(mode="EDIT")
    root = armature.edit_bones.new("root")
    root.head, root.tail, root.use_deform = (0, 0.02, 0), (0, 0.25, 0), False
    for bone_name, (parent, head, tail) in bones().items():
        bone = armature.edit_bones.new(bone_name)
        bone.head, bone.tail = head, tail
        bone.parent = armature.edit_bones[parent]
        bone.align_roll((0, -1, 0) if abs(tail[2] - head[2]) > 0.6 * np.linalg.norm(tail - head) else (0, 0, 1))
    bpy.ops.object.mode_set(mode="OBJECT")
    return rig


def make_object(name: str, mesh: Mesh) -> Any:
    """A mesh object in the scene."""
    verts, faces = mesh
    data = bpy.data.meshes.new(name)
    data.from_pydata(verts.tolist(), [], faces.tolist())
    data.validate()
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def fused(mesh: Mesh, voxel: float, smooth: int) -> Mesh:
    """One closed smooth surface around overlapping shapes: voxel remesh, then Laplacian smoothing."""
    thing = make_object("fuse", mesh)
    remesh = thing.modifiers.new("remesh", "REMESH")
    remesh.mode, remesh.voxel_size, remesh.use_smooth_shade = "VOXEL", voxel, True
    soften = thing.modifiers.new("soften", "SMOOTH")
    soften.factor, soften.iterations = 0.5, smooth
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    result = mesh_arrays(evaluated.to_mesh())
    evaluated.to_mesh_clear()
    bpy.data.objects.remove(thing)
    return result


def mesh_arrays(mesh: Any) -> Mesh:
    """(verts (V, 3), triangles (F, 3)) of a Blender mesh."""
    verts = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", verts)
    mesh.calc_loop_triangles()
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    return verts.reshape(-1, 3).astype(float), faces.reshape(-1, 3).astype(np.int64)


def bone_heat(mesh: Mesh, rig: Any, names: list[str], without: tuple[str, ...]) -> Array:
    """Blender's automatic weights (V, B) of a clean closed mesh, rows summing to 1; no `without` bones."""
    for name in without:
        rig.data.bones[name].use_deform = False
    thing = make_object("heat", mesh)
    bpy.ops.object.select_all(action="DESELECT")
    thing.select_set(True)
    rig.select_set(True)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.parent_set(type="ARMATURE_AUTO")
    column = {name: i for i, name in enumerate(names)}
    groups = [column.get(group.name) for group in thing.vertex_groups]
    weights = np.zeros((len(mesh[0]), len(names)))
    for vertex in thing.data.vertices:
        for element in vertex.groups:
            if (target := groups[element.group]) is not None:
                weights[vertex.index, target] = element.weight
    bpy.data.objects.remove(thing)
    for name in without:
        rig.data.bones[name].use_deform = True
    total = weights.sum(axis=1, keepdims=True)
    if not (total > 1e-3).all():
        raise RuntimeError(f"Bone heat left {int((total <= 1e-3).sum())} vertices without weights.")
    return weights / total


def baked_openness(mesh: Mesh, samples: int) -> Array:
    """How open each vertex is to the sky around it, 0 (hidden) to 1, baked by Cycles; (V,)."""
    thing = make_object("bake", mesh)
    attribute = thing.data.color_attributes.new("openness", "FLOAT_COLOR", "POINT")
    thing.data.color_attributes.active_color = attribute
    material = bpy.data.materials.new("bake")
    thing.data.materials.append(material)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.seed = "CPU", samples, 0
    world = scene.world or bpy.data.worlds.new("bake")
    scene.world = world
    world.light_settings.distance = 0.6
    _only(thing)
    bpy.ops.object.bake(type="AO", target="VERTEX_COLORS")
    values = np.empty(len(attribute.data) * 4, np.float32)
    attribute.data.foreach_get("color", values)
    bpy.data.objects.remove(thing)
    return values.reshape(-1, 4)[:, 0].astype(float)


def add_action(rig: Any, name: str, frames: int, turns_at: Callable[[float], Turns]) -> None:
    """Key a looping action of `frames` frames on the armature; `turns_at(phase)` with phase in 0..1."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, frames
    for frame in range(1, frames + 2, 3):  # every third: Blender's curves are smooth in between
        for bone in rig.pose.bones:
            bone.rotation_mode = "QUATERNION"
            bone.rotation_quaternion = (1, 0, 0, 0)
        turn_bones(rig, turns_at((frame - 1) / frames), frame)
    rig.animation_data.action.name = name
    scene.frame_set(1)


def _only(thing: Any) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing
