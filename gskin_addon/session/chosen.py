# SPDX-License-Identifier: GPL-3.0-or-later
"""The objects that a click is about: those named in the panel, else those selected."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import bpy

from ..scene.splat_object import is_splat_object

if TYPE_CHECKING:
    from .properties import GSkinSettings


def panel_settings(context: bpy.types.Context) -> GSkinSettings:
    """The scene's choices for Auto-Skin, `scene.gskin`."""
    scene: Any = context.scene
    settings: GSkinSettings = scene.gskin
    return settings


def _in_scene(obj: bpy.types.Object, scene: Any) -> bool:
    # An object that was deleted lives on while a property names it, so being in bpy.data proves nothing.
    return scene.objects.get(obj.name) == obj


def is_splats(settings: GSkinSettings, obj: bpy.types.Object) -> bool:
    return is_splat_object(obj) and _in_scene(obj, settings.id_data)


def is_armature(settings: GSkinSettings, obj: bpy.types.Object) -> bool:
    return obj.type == "ARMATURE" and _in_scene(obj, settings.id_data)


def is_proxy(settings: GSkinSettings, obj: bpy.types.Object) -> bool:
    return obj.type == "MESH" and not is_splat_object(obj) and _in_scene(obj, settings.id_data)


def chosen_splats(context: bpy.types.Context) -> bpy.types.Object | None:
    """The splat object of the settings, else the active or the only selected one."""
    settings = panel_settings(context)
    if settings.splats is not None and is_splats(settings, settings.splats):
        return settings.splats
    return _selected(context, is_splat_object)


def chosen_armature(context: bpy.types.Context) -> bpy.types.Object | None:
    """The armature of the settings, else the selected, else the one the splats follow, else the only one."""
    settings = panel_settings(context)
    if settings.armature is not None and is_armature(settings, settings.armature):
        return settings.armature
    selected = _selected(context, lambda obj: obj.type == "ARMATURE")
    if selected is not None:
        return selected
    splats = chosen_splats(context)
    followed = splats.find_armature() if splats is not None else None
    if followed is not None:
        return followed
    armatures = [obj for obj in context.scene.objects if obj.type == "ARMATURE"]
    return armatures[0] if len(armatures) == 1 else None


def proxy_mesh(context: bpy.types.Context) -> bpy.types.Object | None:
    """The proxy mesh of the settings, where it is still in the scene."""
    settings = panel_settings(context)
    return settings.proxy if settings.proxy is not None and is_proxy(settings, settings.proxy) else None


def _selected(context: bpy.types.Context, fits: Callable[[bpy.types.Object], bool]) -> bpy.types.Object | None:
    active = context.view_layer.objects.active
    if active is not None and fits(active):
        return active
    found = [obj for obj in context.view_layer.objects.selected if fits(obj)]
    return found[0] if len(found) == 1 else None
