# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the splats of every 3D view, and follows what changes: poses, frames, views, settings, undo, files."""

from __future__ import annotations

import traceback
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...core.render.drawn_splats import DrawnSplats
from ...core.render.screen_space import is_orthographic
from ...core.render.view_order import back_to_front, eye_of, view_colors, view_depths
from ..splat_object import is_splat_object
from . import composite, shaders, switch
from .drawing import Target, draw_into, make_target
from .reading import RestSplats, drawn_limit, read_posed, read_rest
from .shaders import gpu_state
from .sorter import Sorter
from .textures import PoseTextures, color_texture, image_texture, order_texture, pose_textures

CLASSES = ()

POLL = 0.01
"""Seconds between two looks whether the thread is done."""
VIEWS = 8
"""Views whose order and target are kept; one of a 3D view's four regions is a view."""

_sorter = Sorter()
_handle: Any = None
_pose_version: dict[int, int] = {}
"""By session id of an object: rises with every change of its evaluated points."""
_rest_version: dict[int, int] = {}
_rest: dict[int, tuple[Any, RestSplats | None]] = {}
_posed: dict[Any, tuple[Any, DrawnSplats | None]] = {}
_textures: OrderedDict[Any, PoseTextures] = OrderedDict()
_views: OrderedDict[int, View] = OrderedDict()


@dataclass
class View:
    """What is kept of one region from redraw to redraw."""

    target: Target | None = None
    selected: Target | None = None
    order: Any = None
    colors: Any = None
    layout: Any = None
    """Objects and splats that the order is of: with others it cannot be used."""
    order_key: Any = None
    color_key: Any = None
    drawn_key: Any = None
    selected_key: Any = None
    depths: Any = None
    depths_seen: int = 0
    depth_texture: Any = None


@dataclass(frozen=True)
class Shown:
    """An object to draw: its identity with the version of its pose, and its splats in the world."""

    obj: bpy.types.Object
    key: Any
    rest_key: Any
    splats: DrawnSplats


def draw() -> None:
    """The draw handler of 3D views. An error ends the drawing, and is shown in the panel."""
    context = bpy.context
    if not switch.wanted(context.scene):
        return
    try:
        _draw(context)
    except Exception as error:
        traceback.print_exc()
        switch.fail(f"{type(error).__name__}: {error}")
        # Nothing of the file may be changed while Blender draws.
        bpy.app.timers.register(_after_failure, first_interval=0.0)


def _draw(context: bpy.types.Context) -> None:
    shown = _shown_objects(context)
    if not shown:
        return
    view_matrix = np.array(gpu.matrix.get_model_view_matrix(), np.float64)
    projection = np.array(gpu.matrix.get_projection_matrix(), np.float64)
    _, _, width, height = gpu_state.viewport_get()
    region = context.region
    key = region.as_pointer() if region is not None else 0
    view = _views.setdefault(key, View())
    _views.move_to_end(key)
    while len(_views) > VIEWS:
        _views.popitem(last=False)
    other = region is None or (region.width, region.height) != (width, height)
    objects = [one.splats for one in shown]
    pose_key = tuple(one.key for one in shown)
    pose = _pose_textures(pose_key, objects)
    _arrange(view, key, shown, view_matrix, projection, at_once=other)

    depths = composite.view_depths() if _is_depth_needed(context) else None
    same = view.depths is depths or (
        view.depths is not None and depths is not None and np.array_equal(view.depths, depths)
    )
    if not same:
        view.depths, view.depth_texture = depths, None if depths is None else image_texture(depths)
        view.depths_seen += 1
    matrices = [splats.matrix for splats in objects]
    where = (view_matrix.tobytes(), projection.tobytes(), b"".join(m.tobytes() for m in matrices), width, height)
    if view.target is None or (view.target.width, view.target.height) != (width, height):
        view.target, view.selected, view.drawn_key = make_target(width, height), None, None
    drawn_key = (pose_key, view.order_key, view.color_key, where, view.depths_seen)
    if view.drawn_key != drawn_key:
        draw_into(
            view.target, pose, matrices, view.order, view.colors, view_matrix, projection, depths=view.depth_texture
        )
        view.drawn_key = drawn_key
    outlined, color = _outline(context, view, shown, pose, view_matrix, projection, drawn_key)
    overlay = composite.overlay_in_front() if _is_something_in_front(context) else None
    reach = max(1, round(context.preferences.system.pixel_size))
    composite.lay_over(view.target, outlined=outlined, outline=color, reach=reach, overlay=overlay)


def _shown_objects(context: bpy.types.Context) -> list[Shown]:
    """The splat objects that the view shows and whose points are there."""
    layer, space, depsgraph = context.view_layer, context.space_data, context.view_layer.depsgraph
    if isinstance(space, bpy.types.SpaceView3D) and not space.show_object_viewport_mesh:
        return []
    viewport = space if isinstance(space, bpy.types.SpaceView3D) else None
    shown = []
    for obj in layer.objects:
        if obj.type != "MESH" or not switch.is_drawn(obj) or obj.mode in switch.OTHER_MODES:
            continue
        if not obj.visible_get(view_layer=layer, viewport=viewport):
            continue
        evaluated = obj.evaluated_get(depsgraph)
        uid = obj.session_uid
        limit = drawn_limit(evaluated)
        rest_key = (uid, obj.data.session_uid, _rest_version.get(uid, 0), len(obj.data.vertices), limit)
        if _rest.get(uid, (None,))[0] != rest_key:
            _rest[uid] = rest_key, read_rest(obj, limit)
        rest = _rest[uid][1]
        if rest is None:
            continue
        key = (rest_key, _pose_version.get(uid, 0), context.scene.session_uid, layer.name)
        if _posed.get(uid, (None,))[0] != key or _posed[uid][1] is None:
            _posed[uid] = key, read_posed(evaluated, rest, limit)
        splats = _posed[uid][1]
        if splats is not None and splats.count:
            matrix = np.array(evaluated.matrix_world, np.float64)
            shown.append(Shown(obj, key, rest_key, replace(splats, matrix=matrix)))
    return shown


def _pose_textures(key: Any, objects: list[DrawnSplats]) -> PoseTextures:
    if key not in _textures:
        _textures[key] = pose_textures(objects)
        while len(_textures) > 2:
            _textures.popitem(last=False)
    _textures.move_to_end(key)
    return _textures[key]


def _arrange(
    view: View, asker: int, shown: list[Shown], view_matrix: Any, projection: Any, *, at_once: bool
) -> None:
    """Keep order and colours of a view up to date: by the thread, or now where there are none that fit."""
    objects = [one.splats for one in shown]
    layout = tuple((one.rest_key, one.splats.count) for one in shown)
    matrices = b"".join(splats.matrix.tobytes() for splats in objects)
    axis = view_matrix[2].tobytes()
    order_key = (tuple(one.key for one in shown), matrices, axis)
    turning = any(splats.sh.shape[1] > 1 and splats.colors is None for splats in objects)
    special = any(splats.colors is not None for splats in objects)
    color_key: Any = (layout,)
    if turning:
        color_key = (order_key[0], matrices, view_matrix.tobytes(), is_orthographic(projection))
    elif special:
        color_key = (order_key[0],)
    key = (order_key, color_key)
    at_once = at_once or view.layout != layout or view.order is None
    if key == (view.order_key, view.color_key):
        return
    recolor = view.color_key != color_key or view.layout != layout

    def job() -> Any:
        depths = [view_depths(splats, view_matrix) for splats in objects]
        order = back_to_front(np.concatenate(depths))
        if not recolor:
            return layout, order, None, objects
        eyes = (eye_of(view_matrix, projection, splats.matrix) for splats in objects)
        return layout, order, [view_colors(splats, eye) for splats, eye in zip(objects, eyes, strict=True)], objects

    done = (key, job()) if at_once else _sorter.take(asker)
    if done is not None and done[1][0] == layout:
        made_for, (view.layout, order, colors, sorted_objects) = done
        view.order, view.order_key = order_texture(order), made_for[0]
        if colors is not None:
            view.colors, view.color_key = color_texture(sorted_objects, colors), made_for[1]
    if not at_once and (view.order_key, view.color_key) != key:
        _sorter.ask(asker, key, job)
        if not bpy.app.timers.is_registered(_look):
            bpy.app.timers.register(_look, first_interval=POLL)


def _look() -> float | None:
    """Timer: draw again when the thread has something."""
    if _sorter.has_results():
        redraw()
    return POLL if _sorter.is_busy() else None


def _is_depth_needed(context: bpy.types.Context) -> bool:
    """Whether something may stand before the splats, and the view tells its depth."""
    space = context.space_data
    if not isinstance(space, bpy.types.SpaceView3D):
        return True
    shading = space.shading
    if shading.type in {"SOLID", "WIREFRAME"} and (shading.show_xray if shading.type == "SOLID" else True):
        return False
    if shading.type not in {"SOLID", "WIREFRAME"} and not space.overlay.show_overlays:
        return False
    return any(not obj.show_in_front for obj in _others(context, space))


def _is_something_in_front(context: bpy.types.Context) -> bool:
    space = context.space_data
    if not isinstance(space, bpy.types.SpaceView3D) or not space.overlay.show_overlays:
        return False
    return any(obj.show_in_front for obj in _others(context, space))


def _others(context: bpy.types.Context, space: bpy.types.SpaceView3D) -> Iterator[bpy.types.Object]:
    """What a view shows beside the splats that the shader draws."""
    layer = context.view_layer
    for obj in layer.objects:
        if not switch.is_drawn(obj) and obj.visible_get(view_layer=layer, viewport=space):
            yield obj


def _outline(
    context: bpy.types.Context, view: View, shown: list[Shown], pose: PoseTextures, view_matrix: Any, projection: Any,
    drawn_key: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """The texture whose alpha is outlined and the linear colour; (None, None) where nothing is selected."""
    space = context.space_data
    chosen = [one.obj.select_get(view_layer=context.view_layer) for one in shown]
    if not any(chosen) or context.mode != "OBJECT" or not isinstance(space, bpy.types.SpaceView3D):
        return None, None
    if not space.overlay.show_overlays or not space.overlay.show_outline_selected:
        return None, None
    theme = context.preferences.themes[0].view_3d
    active = context.view_layer.objects.active
    is_active = any(one.obj == active and taken for one, taken in zip(shown, chosen, strict=True))
    srgb = np.array(theme.object_active if is_active else theme.object_selected, np.float64)[:3]
    color = tuple(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).tolist())
    if all(chosen):
        return view.target.texture, color
    key = (drawn_key, tuple(chosen))
    if view.selected is None or view.selected_key != key:
        ends = np.cumsum([0, *(one.splats.count for one in shown)])
        parts = [np.arange(ends[i], ends[i + 1]) for i, taken in enumerate(chosen) if taken]
        # Alpha adds up to the same in any order.
        order = np.concatenate(parts)
        view.selected = view.selected or make_target(view.target.width, view.target.height)
        draw_into(
            view.selected, pose, [one.splats.matrix for one in shown], order_texture(order), view.colors, view_matrix,
            projection, count=len(order), depths=view.depth_texture,
        )  # fmt: skip
        view.selected_key = key
    return view.selected.texture, color


def redraw() -> None:
    """Have every 3D view drawn again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


@persistent
def follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """After any change: note which splats have others in their place, and give new objects to the shader."""
    if bpy.app.background:
        return
    meshes = set()
    for update in depsgraph.updates:
        if isinstance(update.id, bpy.types.Mesh):
            meshes.add(update.id.original.session_uid)
    for update in depsgraph.updates:
        obj = update.id.original if isinstance(update.id, bpy.types.Object) else None
        if obj is None or not is_splat_object(obj):
            continue
        if update.is_updated_geometry:
            _bump(_pose_version, obj.session_uid)
            if obj.data.session_uid in meshes:
                _bump(_rest_version, obj.session_uid)
        switch.apply_to(obj)


@persistent
def start_over(*_: object) -> None:
    """After undo, redo or another file nothing that was kept is sure to be right."""
    _forget()
    if not bpy.app.background:
        switch.apply_to_all()
        redraw()


@persistent
def before_saving(*_: object) -> None:
    """A file opened without the add-on has to show something."""
    switch.give_ellipsoids_back()


@persistent
def after_saving(*_: object) -> None:
    if not bpy.app.background:
        switch.apply_to_all()


def _bump(versions: dict[int, int], uid: int) -> None:
    versions[uid] = versions.get(uid, 0) + 1


def _after_failure() -> None:
    switch.give_ellipsoids_back()
    redraw()


def _forget() -> None:
    _sorter.forget()
    for kept in (_rest, _posed, _textures, _views):
        kept.clear()
    # Versions go on rising, so that no key of before comes back.
    for versions in (_pose_version, _rest_version):
        for uid in versions:
            _bump(versions, uid)


def _switched(scene: bpy.types.Scene, context: bpy.types.Context) -> None:
    if switch.setting(scene):
        switch.try_again()
    switch.apply_to_all()
    redraw()


HANDLERS = (
    (bpy.app.handlers.depsgraph_update_post, follow),
    (bpy.app.handlers.frame_change_post, follow),
    (bpy.app.handlers.undo_post, start_over),
    (bpy.app.handlers.redo_post, start_over),
    (bpy.app.handlers.load_post, start_over),
    (bpy.app.handlers.save_pre, before_saving),
    (bpy.app.handlers.save_post, after_saving),
)


def register() -> None:
    global _handle
    scenes: Any = bpy.types.Scene
    scenes.gskin_draw_splats = bpy.props.BoolProperty(
        name="True Splats",
        description="Draw Gaussian splats in the 3D view as splats, blended and in order, and not as ellipsoids",
        default=True,
        update=_switched,
    )
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", "POST_VIEW")
        bpy.app.timers.register(_after_registering, first_interval=0.0)


def _after_registering() -> None:
    # While add-ons register, the file cannot be changed.
    if _handle is not None:
        switch.apply_to_all()
        redraw()


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    for timer in (_look, _after_failure, _after_registering):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    if hasattr(bpy.data, "objects"):
        switch.give_ellipsoids_back()
    _forget()
    shaders.forget()
    scenes: Any = bpy.types.Scene
    del scenes.gskin_draw_splats
