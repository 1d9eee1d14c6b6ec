# SPDX-License-Identifier: GPL-3.0-or-later
"""A captured person holds a helmet against the thigh: bend the arm, mark the helmet by three lassos, separate it; and
how long that takes.

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
from addon import find_rig, find_splats, part, rest, unsettled, working
from arriving import PANELS, arrive, auto_skin, bring_in, choose, remember
from bpy_extras.view3d_utils import location_3d_to_region_2d
from buttons import Buttons, finished
from stage import Hands, Stage, Story, View, perform, story_parser
from work_clock import CLICK, KEY, TURN, VIEW, WorkClock, drawing

BEND = {"forearm.R": (40, 0, -30)}
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
    buttons = Buttons(stage, hands, view)
    yield from arrive(stage, hands, view, *PANELS)
    _, rig = bring_in(view, options.splats, options.rig, "-y")
    rig.hide_set(True)
    remember(view, "Bring in splats and armature")
    yield from auto_skin(stage, view, confirmed=True)
    look(view, (-1.0, 0.2, 0.06))
    turn(1)
    yield from settled(stage, view)
    yield from hands.shoot("h00_before")
    before = dragged()
    stage.numbers["thigh and jacket that follow the hand, before"] = before
    turn(-1)
    yield from buttons.show("weights")
    clock = WorkClock(stage, view)
    yield from free(stage, hands, view, buttons, clock)
    look(view, (-1.0, 0.2, 0.06))
    began = time.monotonic()
    clock.begin()
    turn(1)
    yield from clock.until_drawn("bend the arm", TURN, began, lambda: not unsettled(find_splats()))
    judge_time(stage, clock)
    yield from settled(stage, view)
    yield from hands.shoot("h05_after")
    after = stage.numbers["thigh and jacket that follow the hand, after"] = dragged()
    stage.check("the helmet is free", after < 0.1 * before, f"{before} splats followed the hand, now {after}")
    if options.again:
        yield from auto_skin(stage, view, confirmed=True)
        yield from settled(stage, view)
        yield from hands.shoot("h06_again")
        again = dragged()
        stage.check("and stays so when Auto-Skin runs again", again < 0.1 * before, again)
    yield from german(hands, view, buttons)


def free(stage: Stage, hands: Hands, view: View, buttons: Buttons, clock: WorkClock) -> Story:
    """Edit Mode, three lassos, Separate Selection, and back; each step timed."""
    find_rig().hide_set(True)
    choose(view, find_splats())
    look(view, VIEWS[0][1], parallel=True)
    yield 1.0
    stage.chapter = "edit"
    yield from hands.move(*view.middle())
    clock.begin()
    yield from hands.keys("Tab")
    yield from clock.until_drawn("Tab", KEY, hands.released, lambda: find_splats().mode == "EDIT")
    view.space.shading.show_xray = True
    for number, (mode, direction, outline) in enumerate(VIEWS, start=1):
        began = time.monotonic()
        clock.begin()
        look(view, direction, parallel=True)
        with view.override():
            bpy.ops.wm.tool_set_by_id(name="builtin.select_lasso")
            tool = bpy.context.workspace.tools.from_space_view3d_mode("EDIT_MESH", create=False)
            tool.operator_properties("view3d.select_lasso").mode = mode
        yield from clock.until_drawn(f"view {number}", VIEW, began)
        points = [*places(view, outline), places(view, outline)[0]]
        before = finished()
        stage.chapter = f"lasso {number}"
        # Quickly: where drawing takes a second, a slow hand's points would be passed over.
        yield from hands.stroke(points)
        yield from clock.until_drawn(
            f"lasso {number}", drawing(points), hands.released, lambda before=before: finished() != before
        )
        yield from hands.shoot(f"h0{number}_lasso")
    chosen = int(part("scene.weight_edits").selected_splats(find_splats()).sum())
    stage.check("three lassos select the helmet", 8_000 < chosen < 20_000, f"{chosen:,}")
    button = yield from buttons.find("gskin.separate_parts")  # a person sees it
    stage.check("the button Separate Selection is found", button is not None, button)
    stage.chapter = "separate"
    if button is not None:
        before = finished()
        clock.begin()
        yield from hands.click(*button)
        yield from clock.until_drawn(
            "Separate Selection", CLICK, hands.released, lambda: finished() != before and not working(), 120.0
        )
    stage.numbers["Separate longest busy s"] = max(stage.busy("separate"), default=0.0)
    stage.numbers["redraws during Separate"] = stage.redraws["separate"]
    stage.chapter = "after"
    seams = part("scene.names").SIDE
    stage.check("there is a seam", seams in find_splats().data.attributes)
    yield from hands.shoot("h04_separated")
    yield from hands.move(*view.middle())
    clock.begin()
    yield from hands.keys("Tab")
    yield from clock.until_drawn("Tab again", KEY, hands.released, lambda: find_splats().mode == "OBJECT")
    view.space.shading.show_xray = False


def judge_time(stage: Stage, clock: WorkClock) -> None:
    """From the first lasso to the bent arm: under a minute, where the machine's part is that of a quiet one."""
    whole = clock.total("lasso 1")
    for step in (*clock.steps, whole):
        for column in ("hand", "machine", "processor"):
            stage.numbers[f"{step.what}: {column} s"] = getattr(step, column)
    pace = stage.numbers["pace of the work"] = stage.pace.mean(*stage.chapter_times("separate"))
    stage.check("the helmet is free in under a minute", whole.hand + whole.machine / pace < 60.0,
                f"hand {whole.hand:.1f} s, machine {whole.machine:.1f} s at pace {pace:.1f}")  # fmt: skip


def german(hands: Hands, view: View, buttons: Buttons) -> Story:
    """The side bar in German, from top to bottom, for people to look at."""
    preferences = bpy.context.preferences.view
    preferences.language = "de_DE"
    preferences.use_translate_interface = preferences.use_translate_tooltips = True
    yield from buttons.show(*PANELS)
    yield 1.0
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
        part("scene.posing").turn_bones(rig, BEND)
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
    """Read the arguments behind `--` and start."""
    parser = story_parser()
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--again", action="store_true", help="also run Auto-Skin once more")
    perform(story, parser)


if __name__ == "__main__":
    main()

