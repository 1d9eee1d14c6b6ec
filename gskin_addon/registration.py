# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender gets from gskin, in the order in which it gets it."""

from __future__ import annotations

from typing import Any

import bpy

from .operators import (
    anchor,
    assign_to_bone,
    auto_skin,
    bind,
    blend_weights,
    cancel_runtime,
    center_rig,
    check_again,
    check_python,
    cleanup,
    clear_flecks,
    command_line,
    compare,
    confidence,
    enable_deform,
    even_scale,
    export_glb,
    fabric,
    fit_skeleton,
    fix_rig_scale,
    flood_weights,
    follow_neighbours,
    import_skeleton,
    import_splats,
    install_runtime,
    job_presets,
    make_riggable,
    mark_landmark,
    mirror_weights,
    moves_with,
    pick_splats,
    place,
    pose_rig,
    remove_runtime,
    render_splats,
    renew_display,
    repair_runtime,
    save_weights,
    select_splats,
    separate_parts,
    sharpen_weights,
    smooth_weights,
    standard_view,
    test_poses,
    transfer_weights,
    try_it,
)
from .scene import (
    fabric_renewal,
    fabric_view,
    follow_display,
    follow_transforms,
    handlers,
    helpers,
    leftovers,
    overlay,
    parted,
    webp_images,
)
from .scene.viewport import following as viewport_following
from .scene.viewport import handler as viewport_handler
from .session import deleted, guidance_settings, live_pictures, properties, render_settings, running_job
from .ui import job_presets as job_presets_menu
from .ui import manual, panel, preferences, render_panel, select_menu, skeleton_panel, splat_panels, translations

# Each has CLASSES, HANDLERS (list of Blender, function) where it follows what happens, and register() and unregister()
# where there is more to do.
MODULES = (
    translations,
    webp_images,
    guidance_settings,
    properties,
    render_settings,
    deleted,
    running_job,
    live_pictures,
    preferences,
    overlay,
    check_python,
    install_runtime,
    repair_runtime,
    cancel_runtime,
    remove_runtime,
    import_splats,
    make_riggable,
    fit_skeleton,
    mark_landmark,
    import_skeleton,
    place,
    enable_deform,
    even_scale,
    fix_rig_scale,
    center_rig,
    check_again,
    cleanup,
    renew_display,
    pick_splats,
    standard_view,
    bind,
    save_weights,
    export_glb,
    confidence,
    select_splats,
    moves_with,
    try_it,
    test_poses,
    smooth_weights,
    sharpen_weights,
    follow_neighbours,
    assign_to_bone,
    flood_weights,
    mirror_weights,
    transfer_weights,
    blend_weights,
    separate_parts,
    fabric,
    compare,
    pose_rig,
    anchor,
    auto_skin,
    render_splats,
    clear_flecks,
    command_line,
    job_presets,
    job_presets_menu,
    panel,
    render_panel,
    skeleton_panel,
    splat_panels,
    select_menu,
    manual,
    parted,
    handlers,
    helpers,
    follow_transforms,
    follow_display,
    viewport_handler,
    viewport_following,
    fabric_view,
    fabric_renewal,
    leftovers,
)


def register() -> None:
    """Register all classes, properties, menus and handlers."""
    for module in MODULES:
        register_module(module)


def unregister() -> None:
    """Take everything away again, last come first gone."""
    for module in reversed(MODULES):
        unregister_module(module)


def register_module(module: Any) -> None:
    """Give Blender the classes and handlers of one of `MODULES`."""
    for cls in module.CLASSES:
        if issubclass(cls, bpy.types.Operator) and "bl_description" not in vars(cls) and cls.__doc__:
            # The tip in one line: lines of a docstring are indented in one version of Python and not in another.
            cls.bl_description = " ".join(cls.__doc__.split())
        bpy.utils.register_class(cls)
    for where, handler in getattr(module, "HANDLERS", ()):
        where.append(handler)
    if hasattr(module, "register"):
        module.register()


def unregister_module(module: Any) -> None:
    """Undo `register_module`."""
    if hasattr(module, "unregister"):
        module.unregister()
    for where, handler in getattr(module, "HANDLERS", ()):
        if handler in where:
            where.remove(handler)
    for cls in reversed(module.CLASSES):
        bpy.utils.unregister_class(cls)
