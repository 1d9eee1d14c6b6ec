# SPDX-License-Identifier: GPL-3.0-or-later
"""The objects that a click is about: those named in the panel, else those selected."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import bpy

from ..scene.anchored import proxy_of
from ..scene.blender_splats import is_blender_splats
from ..scene.proxy_object import followed_armature
from ..scene.splat_object import is_splat_object

if TYPE_CHECKING:
    from .properties import GSkinSettings


_last = 0
"""Session id of the splats chosen last."""


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


def is_any_splats(settings: GSkinSettings, obj: bpy.types.Object) -> bool:
    """What may be named as splats: ours, and those of Blender's that Auto-Skin takes over first."""
    return (is_splat_object(obj) or is_blender_splats(obj)) and _in_scene(obj, settings.id_data)


def is_armature(settings: GSkinSettings, obj: bpy.types.Object) -> bool:
    return obj.type == "ARMATURE" and _in_scene(obj, settings.id_data)


def is_proxy(settings: GSkinSettings, obj: bpy.types.Object) -> bool:
    return obj.type == "MESH" and not is_splat_object(obj) and _in_scene(obj, settings.id_data)


def chosen_splats(context: bpy.types.Context) -> bpy.types.Object | None:
    """The splat object of the settings, else the active or the only selected one, else that of the active rig.

    While a rig (or the mesh that splats hang on) is posed, the click is still about its splats; where it moves
    several, about those chosen last.
    """
    global _last
    settings = panel_settings(context)
    if settings.splats is not None and is_splats(settings, settings.splats):
        found: bpy.types.Object | None = settings.splats
    else:
        found = _selected(context, is_splat_object) or _carried_by_active(context)
    if found is not None:
        _last = found.session_uid
    return found


def chosen_blender_splats(context: bpy.types.Context) -> bpy.types.Object | None:
    """Blender's own splat object that the click is about, where no splat object of ours is: named, or selected."""
    if chosen_splats(context) is not None:
        return None
    settings = panel_settings(context)
    named = settings.splats
    if named is not None and is_blender_splats(named) and _in_scene(named, context.scene):
        return named
    return _selected(context, is_blender_splats)


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


def _carried_by_active(context: bpy.types.Context) -> bpy.types.Object | None:
    active = context.view_layer.objects.active
    if active is None or is_splat_object(active) or active.type not in {"ARMATURE", "MESH"}:
        return None
    carried = [obj for obj in context.scene.objects if is_splat_object(obj) and active in _carriers(obj)]
    if len(carried) > 1:
        carried = [obj for obj in carried if obj.session_uid == _last]
    return carried[0] if len(carried) == 1 else None


def _carriers(splats: bpy.types.Object) -> tuple[bpy.types.Object | None, ...]:
    return followed_armature(splats), proxy_of(splats)


def _selected(context: bpy.types.Context, fits: Callable[[bpy.types.Object], bool]) -> bpy.types.Object | None:
    active = context.view_layer.objects.active
    if active is not None and fits(active):
        return active
    found = [obj for obj in context.view_layer.objects.selected if fits(obj)]
    return found[0] if len(found) == 1 else None
