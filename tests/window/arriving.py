# SPDX-License-Identifier: GPL-3.0-or-later
"""How every story about weights begins: an empty scene, the open side bar, splats and rig, and weights on them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from addon import all_splats, find_splats, part, rest, running
from stage import Hands, Stage, Story, View

PANELS = ("skeleton", "display", "select", "weights", "export", "hygiene")
"""Below the main panel; all shut in a new Blender."""


def arrive(stage: Stage, hands: Hands, view: View, *opened: str) -> Story:
    """An empty scene, and GSkin's tab wide enough to read, with the panels `opened` as if their heads had been
    clicked."""
    stage.chapter = "arrive"
    yield 1.0
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    for name in opened:
        open_panel(name)
    view.space.show_region_ui, view.space.show_region_hud = True, False
    yield 0.8
    view.region("UI").active_panel_category = "GSkin"
    # The side bar opens narrow; a person drags its edge once, and so do we.
    edge, (_, y) = view.region("UI").x, view.middle()
    yield from hands.drag((edge, y), (edge - 60, y))


def open_panel(name: str) -> None:
    """One of `PANELS`, open; before the tab is drawn for the first time."""
    panel = getattr(bpy.types, f"GSKIN_PT_{name}")
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()
    bpy.utils.register_class(panel)


def import_splats(view: View, path: Path, up: str) -> Any:
    """The splats of a file, with an undo step as from the menu."""
    with view.override():
        bpy.ops.gskin.import_splats("EXEC_DEFAULT", True, filepath=str(path), up=up)
    return find_splats()


def bring_in(view: View, splats: Path, rig: Path, up: str) -> tuple[Any, Any]:
    """Splats, where they are not there already, and their rig at rest; both chosen and selected, the splats active."""
    obj = find_splats() if all_splats() else import_splats(view, splats, up)
    armature = part("scene.rig_files").import_armature(rig)
    rest(armature)
    chosen = bpy.context.scene.gskin
    chosen.splats, chosen.armature, chosen.guidance = obj, armature, "none"
    choose(view, obj, armature)
    return obj, armature


def choose(view: View, active: Any, *others: Any) -> None:
    """Select these and nothing else."""
    view.window.view_layer.update()  # what has just been removed is still listed before that
    for obj in view.window.view_layer.objects:
        obj.select_set(obj == active or obj in others)
    view.window.view_layer.objects.active = active


def remember(view: View, message: str) -> None:
    """An undo step: Python's own changes are none, a person's are."""
    with view.override():
        bpy.ops.ed.undo_push(message=message)


def auto_skin(stage: Stage, view: View, **options: Any) -> Story:
    """Auto-Skin, to its end."""
    stage.chapter = "job"
    with view.override():
        bpy.ops.gskin.auto_skin("INVOKE_DEFAULT", **options)
    yield running
    yield lambda: not running()
    stage.numbers["job longest busy s"] = max(stage.busy("job"), default=0.0)
    stage.chapter = "skinned"
    yield stage.pause(1.0)
