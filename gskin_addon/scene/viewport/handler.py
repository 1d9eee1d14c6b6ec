# SPDX-License-Identifier: GPL-3.0-or-later
"""The draw handler of 3D views: takes up what the view shows, draws it and lays it over."""

from __future__ import annotations

import traceback
from typing import Any

import bpy
import gpu
import numpy as np

from . import cages, composite, shaders, switch, view_state, visible
from .marks import theme_look
from .outline import outline_color, selected_objects
from .shaders import gpu_state

CLASSES = ()

POLL = 0.01
"""Seconds between two looks whether the thread is done."""

_handle: Any = None


def draw() -> None:
    """Draw the splats of the present 3D view. An error ends the drawing, and is shown in the panel."""
    context = bpy.context
    if not switch.wanted(context.scene):
        return
    if switch.is_out_of_date() and not bpy.app.timers.is_registered(_follow_views):
        # Nothing of the file may be changed while Blender draws.
        bpy.app.timers.register(_follow_views, first_interval=0.0)
    try:
        _draw(context)
    except Exception as error:
        traceback.print_exc()
        switch.fail(f"{type(error).__name__}: {error}")
        # Nothing of the file may be changed while Blender draws.
        bpy.app.timers.register(_after_failure, first_interval=0.0)


def _draw(context: bpy.types.Context) -> None:
    shown = visible.shown_objects(context)
    if not shown:
        return
    # Those of the view being drawn, which off screen are not the region's.
    view = np.array(gpu.matrix.get_model_view_matrix(), np.float64)
    projection = np.array(gpu.matrix.get_projection_matrix(), np.float64)
    size = tuple(gpu_state.viewport_get()[2:])
    region = context.region
    state = view_state.view_state(0 if region is None else region.as_pointer())
    on_screen = region is not None and (region.width, region.height) == size
    if state.arrange(shown, view, projection, at_once=not on_screen) and not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=POLL)
    others = list(visible.others(context))
    cages.remember_fabrics(shown)
    edited = cages.edited_cages(context, shown)
    depths = None
    if not edited and _tells_depth(context.space_data) and any(not obj.show_in_front for obj in others):
        depths = composite.view_depths()
    state.draw(shown, view, projection, size, depths)
    taken = selected_objects(context, shown)
    outlined, color = None, None
    if any(taken):
        outlined = state.selected(shown, taken, view, projection)
        color = outline_color(context, [one.obj for one, here in zip(shown, taken, strict=True) if here])
    overlay = None
    if edited:
        # Neither what stands before the splats nor bones in front can be told from the cage that Blender draws.
        through = is_xray(context.space_data)
        marks = state.marked(edited, view, projection, theme_look(context), through=through)
        composite.lay_over(state.target, marks=marks)
        return
    if _has_overlays(context.space_data) and any(obj.show_in_front for obj in others):
        overlay = composite.overlay_in_front()
    width = max(1, round(context.preferences.system.pixel_size))
    composite.lay_over(state.target, outlined=outlined, outline=color, reach=width, overlay=overlay)


def _has_overlays(space: Any) -> bool:
    return isinstance(space, bpy.types.SpaceView3D) and space.overlay.show_overlays


def _tells_depth(space: Any) -> bool:
    """Whether what stands before the splats shall hide them and can: X-ray shows all through, and the engines of
    Material Preview and Rendered give depths to overlays only."""
    if not isinstance(space, bpy.types.SpaceView3D):
        return True
    return not is_xray(space) and (space.shading.type in {"SOLID", "WIREFRAME"} or space.overlay.show_overlays)


def is_xray(space: Any) -> bool:
    """Whether a view shows, and selects, what is behind."""
    if not isinstance(space, bpy.types.SpaceView3D):
        return False
    shading = space.shading
    return bool({"SOLID": shading.show_xray, "WIREFRAME": shading.show_xray_wireframe}.get(shading.type, False))


def _look() -> float | None:
    """Timer: draw again when the thread has something."""
    if view_state.sorter.has_results():
        redraw()
    return POLL if view_state.sorter.is_busy() else None


def _follow_views() -> None:
    """Timer: a view has gone from Solid to Rendered, or back."""
    switch.apply_to_all()
    redraw()


def _after_failure() -> None:
    view_state.forget()
    switch.give_ellipsoids_back()
    redraw()


def redraw() -> None:
    """Have every 3D view drawn again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    for timer in (_look, _follow_views, _after_failure):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    view_state.forget()
    visible.forget()
    cages.forget()
    shaders.forget()
