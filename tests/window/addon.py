# SPDX-License-Identifier: GPL-3.0-or-later
"""The installed extension, and its objects in the open file, as the stories look at them."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

import bpy
import numpy as np

ADDON = "bl_ext.user_default.gskin_addon"


def part(name: str) -> ModuleType:
    """A module of the installed extension."""
    return importlib.import_module(f"{ADDON}.{name}")


def running() -> bool:
    """Whether an Auto-Skin job runs."""
    return part("session.running_job").state.job is not None


def working() -> bool:
    """Whether an operator of ours goes on while Blender does."""
    window = bpy.context.window_manager.windows[0]
    return any(operator.bl_idname.startswith("GSKIN_OT") for operator in window.modal_operators)


def unsettled(splats: Any) -> bool:
    """Whether new weights do not turn the splats yet. Computing turns meanwhile would keep the slices waiting."""
    return part("scene.handlers").is_unsettled(splats)


def all_splats() -> list[Any]:
    """The splat objects of the scene."""
    is_splats = part("scene.splat_object").is_splat_object
    return [obj for obj in bpy.context.scene.objects if is_splats(obj)]


def find_splats() -> Any:
    """The first of them."""
    return all_splats()[0]


def find_rig() -> Any:
    """The first armature of the scene."""
    return next(obj for obj in bpy.context.scene.objects if obj.type == "ARMATURE")


def rest(rig: Any) -> None:
    """No action, no pose."""
    rig.animation_data_clear()
    for bone in rig.pose.bones:
        bone.matrix_basis.identity()
    bpy.context.view_layer.update()


def read_outside(splats: Any, bones: list[str]) -> np.ndarray:
    """The weights (N, bones) of splats, also while Edit Mode is open."""
    if splats.mode != "EDIT":
        return part("scene.weights").read_weights(splats, bones)[0]
    splats.update_from_editmode()
    pairs = part("scene.vertex_groups").read_pairs(splats, slice(0, len(splats.data.vertices)))
    out = np.zeros((len(splats.data.vertices), len(bones)), np.float32)
    place = {name: number for number, name in enumerate(bones)}
    column = np.array([place.get(group.name, -1) for group in splats.vertex_groups])
    ours = column[pairs[1]] >= 0
    out[pairs[0][ours], column[pairs[1][ours]]] = pairs[2][ours]
    return out


def turned_as_computed(splats: Any) -> bool:
    """Whether the nodes turn the splats as the rig's formulas do with the weights that the splats have now."""
    if splats.mode != "OBJECT":
        return True
    wanted = part("scene.posing").posed_cloud(splats)
    display = part("scene.node_groups").find_display(splats)
    shown = display.show_viewport
    display.show_viewport = False
    mesh = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    quats = part("scene.attributes").read_attribute(mesh, "rotation")
    turn = np.array(splats.matrix_world.to_quaternion())
    display.show_viewport = shown
    if quats is None or len(quats) != wanted.count:
        return False
    w, x, y, z = turn
    a, b, c, d = quats.T
    world = np.stack([w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
                      w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], axis=1)  # fmt: skip
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    return bool(np.abs(np.einsum("nk,nk->n", world, wanted.quats)).min() > 1 - 1e-4)
