# SPDX-License-Identifier: GPL-3.0-or-later
"""Which objects the shader draws: their display then gives bare points in place of ellipsoids, and else ellipsoids.

In Blender 5.3 and later it draws in Solid mode what Material Preview and Rendered show as Blender's own splats.
Nothing is left behind: files are saved with ellipsoids, and they come back where drawing fails or ends.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from ..display_inputs import BY_SHADER, NATIVE
from ..native_nodes import has_native_splats
from ..node_builder import get_input, has_input, set_input
from ..node_groups import find_display
from ..overlay import NONE, overlay_of
from ..rotation_nodes import find_rotation
from ..splat_object import is_splat_object

OTHER_MODES = {"VERTEX_PAINT", "TEXTURE_PAINT", "SCULPT"}
"""Modes in which Blender itself needs or shows the mesh."""
AT_WORK = {"EDIT", "WEIGHT_PAINT"}
"""Modes in which Blender works on the mesh and the splats may be seen all the same: beside the points on its cage, or
in place of its colours of weights."""

_showed_engine = False
"""What `shows_engine` said when all displays were last looked at."""
failure = ""
"""Why the shader draws nothing in this session; empty while all is well."""


def setting(scene: bpy.types.Scene) -> bool:
    """The artist's choice in a scene."""
    return bool(getattr(scene, "gskin_draw_splats", False))


def wanted(scene: bpy.types.Scene) -> bool:
    """Whether the shader shall draw a scene's splats."""
    return not bpy.app.background and not failure and setting(scene)


def shows_weight_colors(obj: bpy.types.Object) -> bool:
    """Whether Weight Paint is left to Blender's own colours of the active group: nothing else is to be shown, or the
    artist's choice in a scene of the object is that."""
    chosen = all(getattr(scene, "gskin_show_in_paint", False) for scene in obj.users_scene)
    return not chosen or overlay_of(obj) == NONE


def can_be_drawn(obj: bpy.types.Object) -> bool:
    """Whether the shader can draw an object as it is now."""
    if not is_splat_object(obj) or obj.library is not None or obj.mode in OTHER_MODES:
        return False
    modifier = find_display(obj)
    if modifier is None or not has_input(modifier, BY_SHADER) or not get_input(modifier, "Display"):
        return False
    if obj.mode == "WEIGHT_PAINT" and shows_weight_colors(obj):
        return False
    return obj.mode in AT_WORK or not (is_native(modifier) and shows_engine())


def shows_overlay_in(obj: bpy.types.Object, mode: str) -> bool:
    """Whether splats in other than captured colours would be seen in another mode of an object."""
    scenes = obj.users_scene
    painted = all(getattr(scene, "gskin_show_in_paint", False) for scene in scenes)
    modes = {"OBJECT", "POSE", "EDIT"} | ({"WEIGHT_PAINT"} if painted else set())
    modifier = find_display(obj)
    return (
        bool(scenes) and all(wanted(scene) for scene in scenes) and mode in modes and obj.library is None
        and modifier is not None and has_input(modifier, BY_SHADER) and bool(get_input(modifier, "Display"))
    )  # fmt: skip


def shall_draw(obj: bpy.types.Object) -> bool:
    """Whether the shader can draw an object, and is wanted in all scenes that have it."""
    scenes = obj.users_scene
    return bool(scenes) and all(wanted(scene) for scene in scenes) and can_be_drawn(obj)


def is_native(modifier: bpy.types.NodesModifier) -> bool:
    """Whether a display gives Blender's own splats where the shader does not draw (Blender 5.3 and later)."""
    return has_input(modifier, NATIVE) and bool(get_input(modifier, NATIVE))


def shows_engine() -> bool:
    """Whether any 3D view is in Material Preview or Rendered: an object is the same in all views, and there Blender's
    own splats stand in the light of the scene."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            space: Any = area.spaces.active
            if area.type == "VIEW_3D" and space.shading.type in {"MATERIAL", "RENDERED"}:
                return True
    return False


def is_out_of_date() -> bool:
    """Whether the kinds of the 3D views have changed so that Blender's own splats shall be drawn by the other."""
    return has_native_splats() and shows_engine() != _showed_engine


def is_drawn(obj: bpy.types.Object) -> bool:
    """Whether the shader is to draw an object: its display is on, and gives points."""
    modifier = find_display(obj) if is_splat_object(obj) else None
    if modifier is None or not has_input(modifier, BY_SHADER):
        return False
    return bool(modifier.show_viewport and get_input(modifier, BY_SHADER) and get_input(modifier, "Display"))


def set_drawn(obj: bpy.types.Object, drawn: bool) -> None:
    """Give an object over to the shader, or its ellipsoids back; nothing is touched where it is so already."""
    modifier = find_display(obj) if is_splat_object(obj) and obj.library is None else None
    if modifier is None or not has_input(modifier, BY_SHADER):
        return
    if bool(get_input(modifier, BY_SHADER)) != drawn:
        set_input(modifier, BY_SHADER, drawn)
    # Bare points let Edit Mode's own be seen; ellipsoids would hide them. Set before, entering evaluates once.
    for nodes in (modifier, find_rotation(obj)):
        if nodes is not None and nodes.show_in_editmode != drawn:
            nodes.show_in_editmode = drawn


def splat_objects() -> Iterator[bpy.types.Object]:
    """All splat objects of the file."""
    return (obj for obj in bpy.data.objects if is_splat_object(obj))


def apply_to(obj: bpy.types.Object) -> None:
    """Bring one object's display in line with what is wanted."""
    set_drawn(obj, shall_draw(obj))


def apply_to_all() -> None:
    """Bring all objects' displays in line with what is wanted."""
    global _showed_engine
    _showed_engine = shows_engine()
    for obj in splat_objects():
        apply_to(obj)


def give_ellipsoids_back() -> None:
    """All objects show ellipsoids again."""
    for obj in splat_objects():
        set_drawn(obj, False)


def fail(reason: str) -> None:
    """Stop drawing for this session, or until the setting is switched on again."""
    global failure
    failure = reason
    print(f"gskin: splats are not drawn by the shader but as ellipsoids: {reason}")


def try_again() -> None:
    """Forget why drawing failed."""
    global failure
    failure = ""
