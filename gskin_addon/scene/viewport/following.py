# SPDX-License-Identifier: GPL-3.0-or-later
"""What the drawing follows: poses, frames, edits, settings, undo, loading and saving files."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..overlay import follow_active_group
from ..splat_object import is_splat_object
from . import cages, selection, switch, view_state, visible
from .handler import redraw

CLASSES = ()


@persistent
def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """After any change: note which splats are elsewhere, and give new objects to the shader."""
    if bpy.app.background:
        return
    ids = [update.id for update in depsgraph.updates]
    meshes = {one.original.session_uid for one in ids if isinstance(one, bpy.types.Mesh)}
    for update in depsgraph.updates:
        obj = update.id.original if isinstance(update.id, bpy.types.Object) else None
        if obj is None or not is_splat_object(obj):
            continue
        selection.changed(obj)
        if update.is_updated_geometry:
            visible.pose_changed(obj)
            if obj.data.session_uid in meshes:
                visible.rest_changed(obj)
        switch.apply_to(obj)
        follow_active_group(obj)


@persistent
def start_over(*_: object) -> None:
    """After undo, redo or another file nothing that was kept is sure to be right."""
    view_state.forget()
    visible.forget()
    cages.forget()
    if not bpy.app.background:
        switch.apply_to_all()
        redraw()


@persistent
def before_saving(*_: object) -> None:
    """A file opened without the add-on has to show something."""
    switch.give_ellipsoids_back()


@persistent
def after_saving(*_: object) -> None:
    """What is shown here goes on being shown."""
    if not bpy.app.background:
        switch.apply_to_all()


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow),
    (bpy.app.handlers.frame_change_post, follow),
    (bpy.app.handlers.undo_post, start_over),
    (bpy.app.handlers.redo_post, start_over),
    (bpy.app.handlers.load_post, start_over),
    (bpy.app.handlers.save_pre, before_saving),
    (bpy.app.handlers.save_post, after_saving),
)


def _switched(scene: bpy.types.Scene, context: bpy.types.Context) -> None:
    if switch.setting(scene):
        switch.try_again()
    _show_anew()


def _show_anew() -> None:
    switch.apply_to_all()
    redraw()


def register() -> None:
    scenes: Any = bpy.types.Scene
    scenes.gskin_draw_splats = bpy.props.BoolProperty(
        name="True Splats",
        description="Draw splats in the 3D view as what they are, blended and in order; off, as ellipsoids, or from "
        "Blender 5.3 on as Blender's own splats, which are grainy in Solid mode",
        default=True,
        update=_switched,
    )
    scenes.gskin_show_in_paint = bpy.props.BoolProperty(
        name="Show in Weight Paint",
        description="In Weight Paint, too, give the splats the colours chosen under Show; off, or with Captured, "
        "Blender's own colours of the active group's weights are seen on the fabric",
        default=True,
        update=_switched,
    )
    if not bpy.app.background:
        # While add-ons register, the file cannot be changed.
        bpy.app.timers.register(_show_anew, first_interval=0.0)


def unregister() -> None:
    if bpy.app.timers.is_registered(_show_anew):
        bpy.app.timers.unregister(_show_anew)
    if hasattr(bpy.data, "objects"):  # not while Blender itself ends
        switch.give_ellipsoids_back()
    scenes: Any = bpy.types.Scene
    del scenes.gskin_draw_splats, scenes.gskin_show_in_paint
