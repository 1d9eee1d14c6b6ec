# SPDX-License-Identifier: GPL-3.0-or-later
"""A captured person holds a helmet against the thigh: bend the arm, mark the helmet by three lassos, separate it.

blender --python tests/window/helmet.py -- --out DIR --splats pc_biker.ply --rig pc_biker_rig.glb

The outlines are those that a person draws around the helmet in the side, front and top view, in metres.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import bpy
import mathutils
from bpy_extras.view3d_utils import location_3d_to_region_2d
from session import find_rig, find_splats, part, rest, running
from stage import Hands, Stage, Story, View
from strokes import open_panel

TURN = {"forearm.R": (40, 0, -30)}
SIDE = [(-0.16, 1.56), (-0.24, 1.68), (-0.34, 1.72), (-0.46, 1.66), (-0.57, 1.49), (-0.61, 1.33), (-0.55, 1.14),
        (-0.46, 1.06), (-0.31, 1.03), (-0.21, 1.09), (-0.14, 1.19), (-0.09, 1.33), (-0.08, 1.42),
        (-0.11, 1.52)]  # fmt: skip
"""(x, z), seen along y."""
FRONT = [(0.43, 1.67), (0.33, 1.72), (0.18, 1.70), (0.12, 1.62), (0.07, 1.50), (0.03, 1.40), (0.05, 1.25), (0.13, 1.08),
         (0.38, 1.01), (0.57, 1.13), (0.63, 1.33), (0.60, 1.47)]  # fmt: skip
"""(y, z), seen along x."""
TOP = [(-0.17, 0.10), (-0.25, 0.03), (-0.35, 0.01), (-0.48, 0.05), (-0.58, 0.16), (-0.63, 0.30), (-0.62, 0.45),
       (-0.54, 0.59), (-0.41, 0.65), (-0.27, 0.64), (-0.17, 0.60), (-0.11, 0.52), (-0.11, 0.40),
       (-0.16, 0.29)]  # fmt: skip
"""(x, y), seen from above."""
VIEWS = (
    ("SET", (0.0, 1.0, 0.0), [(x, 0.3, z) for x, z in SIDE]),
    ("AND", (-1.0, 0.0, 0.0), [(-0.3, y, z) for y, z in FRONT]),
    ("AND", (0.0, 0.0, 1.0), [(x, y, 1.4) for x, y in TOP]),
)


def story(stage: Stage, options: argparse.Namespace) -> Story:
    """All chapters."""
    view = View()
    hands = Hands(options.out, view, stage.views)
    stage.chapter = "arrive"
    yield 1.0
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    open_panel()
    view.space.show_region_ui, view.space.show_region_hud = True, False
    yield 0.8
    view.region("UI").active_panel_category = "GSkin"
    yield from hands.drag((view.region("UI").x, view.middle()[1]), (view.region("UI").x - 60, view.middle()[1]))
    with view.override():
        bpy.ops.gskin.import_splats("EXEC_DEFAULT", True, filepath=str(options.splats), up="-y")
    rig = part("scene.rig_files").import_armature(options.rig)
    rest(rig)
    chosen = bpy.context.scene.gskin
    chosen.splats, chosen.armature, chosen.guidance = find_splats(), rig, "none"
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in (find_splats(), rig))
    view.window.view_layer.objects.active = find_splats()
    rig.hide_set(True)
    with view.override():
        bpy.ops.ed.undo_push(message="Bring in splats and armature")
    yield from skin(stage, view)
    look(view, (-1.0, 0.2, 0.06))
    turn(1)
    yield from settled(stage, view)
    yield from hands.shoot("h00_before")
    before = dragged()
    stage.numbers["thigh and jacket that follow the hand, before"] = before
    turn(-1)
    yield from free(stage, hands, view)
    turn(1)
    look(view, (-1.0, 0.2, 0.06))
    yield from settled(stage, view)
    yield from hands.shoot("h05_after")
    after = stage.numbers["thigh and jacket that follow the hand, after"] = dragged()
    stage.check("the helmet is free", after < 0.1 * before, f"{before} splats followed the hand, now {after}")
    if options.again:
        yield from skin(stage, view)
        yield from settled(stage, view)
        yield from hands.shoot("h06_again")
        again = dragged()
        stage.check("and stays so when Auto-Skin runs again", again < 0.1 * before, again)
    yield from german(stage, hands, view)


def skin(stage: Stage, view: View) -> Story:
    """Auto-Skin as after installation."""
    stage.chapter = "job"
    with view.override():
        bpy.ops.gskin.auto_skin("EXEC_DEFAULT" if bpy.app.background else "INVOKE_DEFAULT", confirmed=True)
    yield running
    yield lambda: not running()
    stage.numbers["job longest busy s"] = max(stage.busy("job"), default=0.0)
    stage.chapter = "skinned"
    yield 1.0


def free(stage: Stage, hands: Hands, view: View) -> Story:
    """Edit Mode, three lassos, Separate Selection."""
    find_rig().hide_set(True)
    find_splats().select_set(True)
    look(view, VIEWS[0][1], parallel=True)
    yield 1.0
    stage.chapter = "edit"
    began = time.monotonic()
    yield from hands.move(*view.middle())
    yield from hands.keys("Tab")
    yield stage.soon(lambda: find_splats().mode == "EDIT", 10.0)
    view.space.shading.show_xray = True
    for number, (mode, direction, outline) in enumerate(VIEWS):
        look(view, direction, parallel=True)
        with view.override():
            bpy.ops.wm.tool_set_by_id(name="builtin.select_lasso")
            tool = bpy.context.workspace.tools.from_space_view3d_mode("EDIT_MESH", create=False)
            tool.operator_properties("view3d.select_lasso").mode = mode
        yield 1.0
        yield from hands.stroke([*places(view, outline), places(view, outline)[0]])
        yield stage.pause(1.0)
        yield from hands.shoot(f"h0{number + 1}_lasso")
    chosen = int(part("scene.weight_edits").selected_splats(find_splats()).sum())
    stage.check("three lassos select the helmet", 8_000 < chosen < 20_000, f"{chosen:,}")
    stage.chapter = "look for the button"
    looked = time.monotonic()
    found = yield from view.find_buttons(hands, "gskin.")
    looked = time.monotonic() - looked  # a person sees it
    stage.check("the button Separate Selection is found", "gskin.separate_parts" in found)
    stage.chapter = "separate"
    clicked = time.monotonic()
    if "gskin.separate_parts" in found:
        yield from hands.click(*found["gskin.separate_parts"])
    seams = part("scene.names").SIDE
    yield stage.soon(lambda: seams in find_splats().data.attributes and find_splats().mode == "EDIT", 60.0)
    stage.numbers["Separate s"] = time.monotonic() - clicked
    stage.numbers["Separate longest busy s"] = max(stage.busy("separate"), default=0.0)
    stage.chapter = "after"
    yield 0.5
    yield from hands.shoot("h04_separated")
    yield from hands.move(*view.middle())
    yield from hands.keys("Tab")
    yield stage.soon(lambda: find_splats().mode == "OBJECT", 10.0)
    view.space.shading.show_xray = False
    stage.numbers["the whole work s"] = time.monotonic() - began - looked


def german(stage: Stage, hands: Hands, view: View) -> Story:
    """The side bar in German, from top to bottom, for people to look at."""
    preferences = bpy.context.preferences.view
    preferences.language = "de_DE"
    preferences.use_translate_interface = preferences.use_translate_tooltips = True
    for name in ("GSKIN_PT_display", "GSKIN_PT_export", "GSKIN_PT_hygiene"):
        panel = getattr(bpy.types, name)
        bpy.utils.unregister_class(panel)
        panel.bl_options = set()
        bpy.utils.register_class(panel)
    yield 1.5
    yield from hands.shoot("g00_german")
    side = view.region("UI")
    for number in (1, 2):
        place = side.x + side.width // 2, view.middle()[1]
        yield from hands.move(*place)
        yield from hands.wheel(10)
        yield 1.0
        yield from hands.shoot(f"g0{number}_german")


def look(view: View, direction: Any, *, parallel: bool = False) -> None:
    """At the helmet from a direction."""
    camera = view.space.region_3d
    camera.view_perspective = "ORTHO" if parallel else "PERSP"
    camera.view_rotation = mathutils.Vector(direction).to_track_quat("Z", "Y")
    camera.view_location, camera.view_distance = ((-0.3, 0.3, 1.4), 1.6) if parallel else ((0.0, 0.1, 1.5), 4.2)


def places(view: View, outline: list[tuple[float, float, float]]) -> list[tuple[int, int]]:
    """Points of the world on the screen."""
    region, out = view.region(), []
    for point in outline:
        x, y = location_3d_to_region_2d(region, view.space.region_3d, mathutils.Vector(point))
        out.append((round(region.x + x), round(view.window.height - region.y - y)))
    return out


def turn(way: int) -> None:
    """Bend the arm, or back."""
    rig = find_rig()
    if way > 0:
        part("scene.posing").turn_bones(rig, TURN)
    else:
        rest(rig)


def settled(stage: Stage, view: View) -> Story:
    """Drawn as it is now."""
    sorter = part("scene.viewport.view_state").sorter
    for _ in range(3):
        view.area.tag_redraw()
        yield 0.5
        yield stage.soon(lambda: not sorter.is_busy() and not sorter.has_results(), 5.0)


def dragged() -> int:
    """Splats of the thigh and the jacket, off the helmet, that follow hand or forearm by more than a tenth."""
    splats = find_splats()
    means = part("scene.splat_object").read_cloud(splats).means
    weights, names = part("scene.weights").read_weights(splats)
    arm = weights[:, [names.index(name) for name in ("hand.R", "forearm.R")]].sum(axis=1)
    # Behind the helmet and below the belt, where there is no arm.
    body = (means[:, 0] > -0.12) & (means[:, 2] < 1.6) & (means[:, 1] < 0.42)
    return int((body & (arm > 0.1)).sum())


def main() -> None:
    """Read the arguments after `--` and start."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--splats", type=Path, required=True)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--again", action="store_true", help="also run Auto-Skin once more")
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :])
    bpy.context.preferences.view.show_splash = False
    stage = Stage(options.out)
    stage.play(story(stage, options))


if __name__ == "__main__":
    main()
