# SPDX-License-Identifier: GPL-3.0-or-later
"""A proxy mesh with learned weights as an object of the scene, and anchored splats in its present pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.anchoring import pose_anchored
from ..core.splats.cloud import SplatCloud
from . import names
from .anchored import proxy_of, read_anchors
from .attributes import read_positions
from .bone_frames import armature_modifier, armature_of
from .splat_object import read_cloud, refuse_edit_mode, to_world

Array = NDArray[Any]


def create_proxy(
    name: str, verts: Array, faces: Array, armature: bpy.types.Object, weights: Array, bones: Sequence[str]
) -> bpy.types.Object:
    """A mesh object of verts (V, 3), world, and faces (F, 3) that `armature` moves by weights (V, B).

    It is drawn as wires and not rendered: the splats that hang on it are what is seen.
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(verts, float).tolist(), [], np.asarray(faces).tolist())
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    obj.display_type, obj.hide_render = "WIRE", True
    bind_proxy(obj, armature, weights, bones)
    return obj


def bind_proxy(obj: bpy.types.Object, armature: bpy.types.Object, weights: Array, bones: Sequence[str]) -> None:
    """Let `armature` move the mesh object by weights (V, B): vertex groups, parent (in place), Armature modifier.

    Vertex groups of these bones are replaced, others stay. Raises InputError where the mesh has other points.
    """
    refuse_edit_mode(obj)
    if len(weights) != len(obj.data.vertices):
        raise InputError(
            f"'{obj.name}' has {len(obj.data.vertices)} points and the weights are for {len(weights)}; "
            "make them again for the mesh as it is."
        )
    bpy.context.view_layer.update()
    if obj.parent is None:
        world = obj.matrix_world.copy()
        obj.parent = armature
        obj.matrix_parent_inverse = armature.matrix_world.inverted()
        obj.matrix_world = world
    for label in bones:
        group = obj.vertex_groups.get(label)
        if group is not None:
            obj.vertex_groups.remove(group)
    for bone, label in enumerate(bones):
        group = obj.vertex_groups.new(name=label)
        for vertex in np.flatnonzero(weights[:, bone] > 0).tolist():
            group.add((vertex,), float(weights[vertex, bone]), "REPLACE")
    modifier = armature_modifier(obj) or obj.modifiers.new(names.ARMATURE_MODIFIER, "ARMATURE")
    modifier.object = armature
    modifier.use_vertex_groups, modifier.use_bone_envelopes = True, False
    # The weights were learned for Eq. 1, not for dual quaternions.
    modifier.use_deform_preserve_volume = False


def followed_armature(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The armature that moves the splats, directly or through the mesh that they are anchored to."""
    proxy = proxy_of(obj)
    return armature_of(obj if proxy is None else proxy)


def posed_anchored(obj: bpy.types.Object) -> SplatCloud:
    """Anchored splats in world space as their proxy lies now, by the core's formulas (float64).

    Raises InputError: not anchored, or the proxy's points are no longer those that were anchored to.
    """
    anchors, verts, faces = read_anchors(obj)
    proxy = proxy_of(obj)
    bpy.context.view_layer.update()
    evaluated = proxy.evaluated_get(bpy.context.evaluated_depsgraph_get())
    posed = read_positions(evaluated.data).astype(np.float64)
    if len(posed) != len(verts):
        raise InputError(
            f"'{proxy.name}' has {len(posed)} points and had {len(verts)} when '{obj.name}' was anchored to it; "
            "undo the change or anchor again."
        )
    matrix = np.linalg.inv(np.array(obj.matrix_world)) @ np.array(evaluated.matrix_world)
    posed = posed @ matrix[:3, :3].T + matrix[:3, 3]
    return to_world(pose_anchored(read_cloud(obj, world=False), anchors, verts, posed, faces), obj)
