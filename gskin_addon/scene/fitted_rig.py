# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons as armature objects: a fitted one as one of Rigify's metarigs where Rigify is there, and any other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import addon_utils
import bpy
import mathutils
import numpy as np

from ..core.rig.skeleton import Skeleton
from ..core.skeleton.fit import Fit

_METARIGS = {
    "human": "armature_basic_human_metarig_add",
    "quadruped": "armature_basic_quadruped_metarig_add",
    "bird": "armature_bird_metarig_add",
}
"""What Rigify adds for each kind of body."""


def rigify_is_on() -> bool:
    """Whether Rigify, which comes with Blender, is enabled."""
    return bool(addon_utils.check("rigify")[1])


def turn_rigify_on() -> bool:
    """Enable Rigify as its check box in the preferences does; whether it is on then. It reads its own preferences, so
    that it cannot be enabled without an entry there."""
    if not rigify_is_on():
        addon_utils.enable("rigify", default_set=True)
    return rigify_is_on()


def create_fitted_rig(fit: Fit, name: str) -> bpy.types.Object:
    """An armature of the fitted bones, in the scene, where the splats are; a metarig where Rigify is on.

    It stands at the feet of the body and is turned as the body is, so that its own x goes across: Blender mirrors
    along it. `X-Axis Mirror` is on where both sides are alike. Rigify's bones without a place in the fit, such as a
    bird's feathers, go along with their parents.
    """
    if rigify_is_on():
        armature = _metarig(fit.kind)
        with _edit_mode(armature):
            _place_bones(armature, fit)
    else:
        armature = _empty_armature()
        with _edit_mode(armature):
            _add_bones(armature.data, fit.skeleton)
    armature.name = armature.data.name = name
    for bone_name, deforms in zip(fit.skeleton.names, fit.deform, strict=True):
        armature.data.bones[bone_name].use_deform = bool(deforms)
    fitted = set(fit.skeleton.names)
    for bone in armature.data.bones:
        if bone.name not in fitted:
            bone.use_deform = False
    armature.matrix_basis = mathutils.Matrix(fit.placement.tolist())
    if rigify_is_on():
        _prepare_controls(armature)
    armature.data.use_mirror_x = fit.alike
    armature.pose.use_mirror_x = fit.alike
    armature.show_in_front = True
    bpy.context.view_layer.update()
    return armature


def _prepare_controls(metarig: bpy.types.Object) -> None:
    """Where Rigify will put the controls: it makes a new rig at the world's origin, not where its metarig stands, but
    leaves one that is there already in its place. It adds it to the scene itself."""
    name = f"RIG-{metarig.name}"
    target = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    target.display_type = "WIRE"
    target.matrix_basis = metarig.matrix_basis
    data: Any = metarig.data
    data.rigify_target_rig = target


def create_armature(skeleton: Skeleton, name: str) -> bpy.types.Object:
    """An armature of the bones of a skeleton in the world, in the scene."""
    armature = _empty_armature()
    with _edit_mode(armature):
        _add_bones(armature.data, skeleton)
    armature.name = armature.data.name = name
    armature.show_in_front = True
    bpy.context.view_layer.update()
    return armature


def _metarig(kind: str) -> bpy.types.Object:
    with _object_mode():
        getattr(bpy.ops.object, _METARIGS[kind])()
    armature = bpy.context.view_layer.objects.active
    armature.matrix_world = mathutils.Matrix()
    return armature


def _empty_armature() -> bpy.types.Object:
    armature = bpy.data.objects.new("Skeleton", bpy.data.armatures.new("Skeleton"))
    bpy.context.scene.collection.objects.link(armature)
    return armature


def _place_bones(armature: bpy.types.Object, fit: Fit) -> None:
    """Put the bones of a metarig in its Edit Mode to where the fit has them; a bone's roll turns along with it."""
    skeleton, edit = fit.skeleton, armature.data.edit_bones
    mirrored = armature.data.use_mirror_x
    armature.data.use_mirror_x = False
    place = {name: number for number, name in enumerate(skeleton.names)}
    before = {bone.name: (bone.head.copy(), bone.tail.copy(), bone.z_axis.copy()) for bone in edit}
    for bone in edit:
        bone.use_connect = bone.use_connect and _stays_connected(bone, place, skeleton)
    moves: dict[str, mathutils.Matrix] = {}
    for bone in edit:  # parents come first
        head, tail, upward = before[bone.name]
        if bone.name in place:
            number = place[bone.name]
            bone.head, bone.tail = skeleton.heads[number], skeleton.tails[number]
            turn = (tail - head).rotation_difference(bone.tail - bone.head)
            size = bone.length / max((tail - head).length, 1e-9)
            move = mathutils.Matrix.Translation(bone.head) @ turn.to_matrix().to_4x4()
            moves[bone.name] = move @ mathutils.Matrix.Scale(size, 4) @ mathutils.Matrix.Translation(-head)
            bone.align_roll(turn @ upward)
        else:
            move = moves[bone.parent.name] if bone.parent is not None else mathutils.Matrix()
            moves[bone.name] = move
            bone.head, bone.tail = move @ head, move @ tail
            bone.align_roll(move.to_quaternion() @ upward)
    armature.data.use_mirror_x = mirrored


def _stays_connected(bone: bpy.types.EditBone, place: dict[str, int], skeleton: Skeleton) -> bool:
    parent = bone.parent
    if parent is None or bone.name not in place or parent.name not in place:
        return True
    gap = skeleton.heads[place[bone.name]] - skeleton.tails[place[parent.name]]
    return float(np.linalg.norm(gap)) < 1e-6


def _add_bones(data: Any, skeleton: Skeleton) -> None:
    """New bones in an armature's data, in Edit Mode."""
    made: list[bpy.types.EditBone] = []
    for name, parent, head, tail in zip(skeleton.names, skeleton.parents, skeleton.heads, skeleton.tails, strict=True):
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = head, tail
        if parent >= 0:
            bone.parent = made[parent]
            bone.use_connect = bool(np.linalg.norm(head - skeleton.tails[parent]) < 1e-6)
        made.append(bone)


@contextmanager
def _object_mode() -> Iterator[None]:
    active = bpy.context.view_layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    yield


@contextmanager
def _edit_mode(armature: bpy.types.Object) -> Iterator[None]:
    """Blender in the Edit Mode of an armature, which is the active object afterwards, in Object Mode."""
    with _object_mode():
        bpy.context.view_layer.objects.active = armature
        bpy.ops.object.mode_set(mode="EDIT")
        try:
            yield
        finally:
            bpy.ops.object.mode_set(mode="OBJECT")
