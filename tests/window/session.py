# SPDX-License-Identifier: GPL-3.0-or-later
"""What a person does on the first evening with GSkin, played in a real Blender window, and looked at.

blender --python tests/window/session.py -- --out DIR --splats FILE.ply --rig RIG.blend [--preset draft]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent))

import bpy
import mathutils
import numpy as np
from addon import ADDON, all_splats, find_rig, find_splats, part, rest, running
from stage import Hands, Stage, Story, View, perform, story_parser, waited

FROZEN = 0.1
"""Seconds for which Blender may not answer while a job runs, on a machine that has nothing else to do."""
SHOTS = (0.08, 0.35, 0.6, 0.85)
POSE = {
    "upper_arm.L": (0, -45, 10), "forearm.L": (0, -58, 0), "hand.L": (0, -14, 0),
    "upper_arm.R": (20, 10, 25), "forearm.R": (-35, 20, 60), "hand.R": (0, 20, 0),
    "spine": (4, 4, -6), "chest": (2, 4, -6), "head": (-4, 10, 14), "ear.L": (0, -18, 0), "ear.R": (0, 14, 0),
    "thigh.L": (-32, 0, -6), "shin.L": (50, 0, 0), "thigh.R": (6, -4, 0), "foot.L": (10, 0, 0),
    "tail.1": (0, 0, 18), "tail.2": (0, 0, 20), "tail.3": (0, 0, 20),
    "cape.1": (14, 0, 6), "cape.2": (12, 0, 0),
}  # fmt: skip


def story(stage: Stage, options: argparse.Namespace) -> Story:
    """All chapters, one after the other."""
    view = View()
    hands = Hands(options.out, view, stage.views)
    yield from arrive(stage, hands, view)
    yield from bring_in(stage, hands, view, options)
    yield from change_of_mind(stage, hands, view)
    yield from auto_skin(stage, hands, view)
    yield from undo_and_redo(stage, hands, view)
    yield from pose(stage, hands, view)
    yield from save_and_reload(stage, hands, view, options.out)
    yield from drop(stage, hands, view, options)
    yield from leave_in_the_middle(stage, view)


def arrive(stage: Stage, hands: Hands, view: View) -> Story:
    """A fresh Blender with the extension on."""
    stage.chapter = "arrive"
    yield 1.0
    stage.numbers["load_before"] = os.getloadavg()[0]
    stage.numbers["python"] = float("{}.{}".format(*sys.version_info))
    stage.numbers["blender"] = float(".".join(map(str, bpy.app.version[:2])))
    stage.check("a window is open", not bpy.app.background and len(bpy.context.window_manager.windows) == 1)
    size = view.window.width, view.window.height
    stage.check("the window has the screen's size", size == (1600, 900), size)
    stage.check("the extension is on", ADDON in bpy.context.preferences.addons)
    stage.check("its operators are there", hasattr(bpy.types, "GSKIN_OT_auto_skin"))
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    with view.override():
        stage.check("without splats Auto-Skin says what is missing", not bpy.ops.gskin.auto_skin.poll())
    view.space.show_region_ui, view.space.show_region_hud = True, False
    yield 0.8
    view.region("UI").active_panel_category = "GSkin"
    # The side bar opens narrow; a person drags its edge once, and so do we.
    edge, (_, y) = view.region("UI").x, view.middle()
    yield from hands.drag((edge, y), (edge - 60, y))
    yield from hands.shoot("00_empty")


def bring_in(stage: Stage, hands: Hands, view: View, options: argparse.Namespace) -> Story:
    """Splats by the operator, the armature from its .blend."""
    stage.chapter = "import"
    started = time.monotonic()
    with view.override():
        # True: with a step in the undo history, as from the menu.
        done = bpy.ops.gskin.import_splats("EXEC_DEFAULT", True, filepath=str(options.splats))
    stage.numbers["import_s"] = time.monotonic() - started
    stage.check("the splats are imported", done == {"FINISHED"})
    splats = find_splats()
    stage.numbers["splats"] = len(splats.data.vertices)
    stage.check("Solid mode shows their colours", view.space.shading.color_type == "VERTEX")
    rig = part("scene.rig_files").import_armature(options.rig)
    rest(rig)
    # Long enough to look at, to move about in and to cancel.
    bpy.context.scene.gskin.preset, bpy.context.scene.gskin.guidance = options.preset, "elastic"
    rig.data.display_type, rig.show_in_front = "STICK", True
    bpy.context.scene.gskin.splats, bpy.context.scene.gskin.armature = splats, rig
    for obj in (splats, rig):
        obj.select_set(False)
    look(view)
    # Python's own changes are no undo steps; a person's are.
    with view.override():
        bpy.ops.ed.undo_push(message="Bring in splats and armature")
    yield 1.0
    with view.override():
        started = time.monotonic()
        bpy.ops.wm.redraw_timer(type="DRAW", iterations=5)
        stage.numbers["view_redraw_s"] = (time.monotonic() - started) / 5
    yield from hands.move(*view.middle())
    yield from hands.shoot("01_panel")
    with view.override():
        stage.check("Auto-Skin can be clicked", bpy.ops.gskin.auto_skin.poll())


def change_of_mind(stage: Stage, hands: Hands, view: View) -> Story:
    """A click on the button, and one on Cancel; then Escape: each time the worker is gone within a second."""
    button = yield from view.find_button(hands, "gskin.auto_skin")
    stage.check("the button is found in the side bar", button is not None, button)
    if button is None:
        return
    for way in ("button", "escape"):
        yield from hands.click(*button)
        yield running
        job = part("session.running_job").state.job
        process = job.client._process
        yield lambda job=job: job.progress.fraction > 0.02 or not running()
        stage.check(f"the job runs ({way})", running())
        if way == "button":
            target = yield from view.find_button(hands, "gskin.cancel_auto_skin")
            stage.check("a Cancel button is in the side bar", target is not None, target)
            if target is None:
                job.cancel()
                asked = time.monotonic()
            else:
                yield from hands.move(*target)
                subprocess.Popen(["xdotool", "click", "1"])
                asked = time.monotonic()
        else:
            yield from hands.move(*view.middle())
            subprocess.Popen(["xdotool", "key", "Escape"])
            asked = time.monotonic()
        yield lambda process=process: process.poll() is not None and not running()
        took = stage.numbers[f"cancel_{way}_s"] = time.monotonic() - asked
        stage.check_time(f"cancelled within a second ({way})", took, 1.0, stage.pace.mean(asked))
        stage.check("a cancelled job leaves the scene alone", untouched(find_splats()))
        yield 0.5
    yield from hands.shoot("02_cancelled")


def auto_skin(stage: Stage, hands: Hands, view: View) -> Story:
    """The whole job, with the bar seen moving and a heart that may not miss a beat."""
    button = yield from view.find_button(hands, "gskin.auto_skin")
    # The same window drawing its side bar as often without a job: what this machine can do at the moment.
    stage.chapter = "control"
    until = time.monotonic() + 5.0
    while time.monotonic() < until:
        view.region("UI").tag_redraw()
        yield 0.1
    modal = timed("modal", bpy.types.GSKIN_OT_auto_skin)
    panel = timed("draw", bpy.types.GSKIN_PT_main)
    stage.chapter = "start"
    clicked = time.monotonic()
    yield from hands.click(*button)
    yield running
    stage.chapter = "job"
    job = part("session.running_job").state.job
    yield from hands.move(*view.middle())
    seen: list[float] = []
    for share in SHOTS:
        yield lambda share=share: job.progress.fraction >= share or not running()
        if not running():
            break
        seen.append(job.progress.fraction)
        yield from hands.shoot(f"03_progress_{round(100 * share):02}")
    yield lambda: job.progress.fraction > 0.985 or not running() or ended(job)
    stage.chapter = "finish"
    # Up to here the operator only looked at the worker.
    looked = len(modal)
    yield lambda: not running()
    stage.chapter = "after"
    yield 0.5
    stage.numbers["job_s"] = time.monotonic() - clicked
    stage.check("the bar was seen at four places", len(seen) == len(SHOTS) and seen == sorted(set(seen)), seen)
    for chapter in ("control", "start", "job", "finish"):
        gaps = np.array(stage.gaps(chapter) or [0.0])
        stage.numbers[f"{chapter}_beats"] = len(gaps)
        stage.numbers[f"{chapter}_longest_gap_s"] = float(gaps.max())
        stage.numbers[f"{chapter}_p99_gap_s"] = float(np.quantile(gaps, 0.99))
        stage.numbers[f"{chapter}_late_beats"] = int((gaps > FROZEN).sum())
        stage.numbers[f"{chapter}_longest_busy_s"] = max(stage.busy(chapter), default=0.0)
    # The last calls write the weights, in slices; they belong to the finish.
    looks, writes = modal[:looked], modal[looked:]
    none = Took(9.0, 9.0)
    stage.numbers["operator_tick_longest_s"] = max(looks, default=none).own
    stage.numbers["write_back_s"] = sum(took.own for took in writes)
    stage.numbers["write_back_longest_s"] = max(writes, default=none).own
    stage.numbers["write_back_longest_busy_s"] = max((took.busy for took in writes), default=9.0)
    stage.numbers["panel_draw_longest_s"] = max(panel, default=none).own
    for chapter in ("control", "job"):
        stage.numbers[f"{chapter}_pace_mean"] = stage.pace.mean(*stage.chapter_times(chapter))
    pace = stage.numbers["job_pace_worst"] = stage.pace.worst(*stage.chapter_times("job"))
    stage.numbers["job_view_redraws"] = stage.redraws["job"]
    stage.check_time("the operator's own time is short", stage.numbers["operator_tick_longest_s"], 0.02, pace)
    stage.check_time("the side bar is drawn quickly", stage.numbers["panel_draw_longest_s"], 0.05, pace)
    longest = max(stage.own_gaps("job"), default=9.0)
    stage.check_time("the window never froze while the job ran", longest, FROZEN, pace)
    # What the main thread itself worked tells more on a busy machine, where even an idle window may not get its turn.
    busy, pace = stage.numbers["job_longest_busy_s"], stage.pace.busy(*stage.chapter_times("job"))
    stage.check_time("nor was its main thread kept busy", busy, FROZEN, pace)
    # The same by the processor's time, which others hardly lengthen; what waits for other threads counts by the clock.
    pace = stage.pace.busy(*stage.chapter_times("finish"))
    stage.check_time("nor in any step of writing the weights", stage.numbers["write_back_longest_busy_s"], FROZEN, pace)
    pace = stage.pace.worst(*stage.chapter_times("finish"))
    stage.check_time("nor did one wait for others", stage.numbers["write_back_longest_s"], FROZEN, pace)
    stage.check("the 3D view is not drawn again for the bar", stage.redraws["job"] < 5, stage.redraws["job"])
    outcome = part("session.running_job").state
    stage.check("the job ended well", not outcome.failed and "follow" in outcome.outcome, outcome.outcome)
    splats, rig = find_splats(), find_rig()
    stage.check("every bone has a vertex group", len(splats.vertex_groups) >= 20, len(splats.vertex_groups))
    weights, _ = part("scene.weights").read_weights(splats)
    stage.check("weights of every splat sum to 1", np.abs(weights.sum(1) - 1).max() < 0.01)
    stage.check("at most four bones move a splat", (weights > 0).sum(1).max() <= 4)
    stage.check("the Armature modifier names the rig", splats.find_armature() == rig)
    yield from hands.shoot("04_done")


def undo_and_redo(stage: Stage, hands: Hands, view: View) -> Story:
    """Control-Z takes the weights away in one step, and brings them back."""
    stage.chapter = "undo"
    yield from hands.move(*view.middle())
    yield from hands.keys("ctrl+z")
    yield stage.soon(lambda: untouched(find_splats()))
    stage.check("one undo takes it all back", untouched(find_splats()), describe(find_splats()))
    stage.check("and leaves the splats and the armature", find_splats() is not None and find_rig() is not None)
    yield from hands.keys("ctrl+shift+z")
    yield stage.soon(lambda: len(find_splats().vertex_groups) >= 20)
    stage.check("one redo brings it back", len(find_splats().vertex_groups) >= 20, describe(find_splats()))


def pose(stage: Stage, hands: Hands, view: View) -> Story:
    """Bones turn, splats follow: as the eye sees and as numpy computes."""
    stage.chapter = "pose"
    rig = find_rig()
    before = drawn_points(find_splats())
    part("scene.posing").turn_bones(rig, POSE)
    yield stage.pause(1.0)
    moved_as_computed(stage, find_splats(), before, "posed")
    times = []
    for angle in (4.0, -4.0, 4.0, -4.0):
        started = time.monotonic()
        part("scene.posing").turn_bones(rig, {"head": (0, angle, 0)})
        bpy.context.view_layer.update()
        times.append(time.monotonic() - started)
    stage.numbers["pose_change_s"] = float(np.median(times))
    bpy.context.view_layer.objects.active = rig
    with view.override():
        bpy.ops.object.mode_set(mode="POSE")
    yield from hands.move(*view.middle())
    yield stage.pause(1.0)
    yield from hands.shoot("05_posed")
    view.space.overlay.show_overlays = False
    yield stage.pause(0.5)
    yield from hands.shoot("06_posed_clean")
    for kind, name in (("MATERIAL", "07_posed_material"),):
        view.space.shading.type = kind
        yield stage.pause(20.0)  # the software driver compiles shaders for that long
        yield from hands.shoot(name)
    view.space.shading.type, view.space.overlay.show_overlays = "SOLID", True
    with view.override():
        bpy.ops.object.mode_set(mode="OBJECT")


def save_and_reload(stage: Stage, hands: Hands, view: View, out: Path) -> Story:
    """What was saved still moves."""
    stage.chapter = "reload"
    path = out / "saved.blend"
    before = drawn_points(find_splats())
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    yield stage.pause(1.5)
    splats = find_splats()
    after = drawn_points(splats)
    stage.check("the pose is the same after reloading", np.abs(after - before).max() < 1e-5)
    part("scene.posing").turn_bones(find_rig(), {"upper_arm.R": (0, 60, 0), "thigh.R": (-40, 0, 0)})
    yield stage.pause(1.0)
    moved_as_computed(stage, splats, after, "reloaded")
    yield from hands.shoot("08_reloaded")


def drop(stage: Stage, hands: Hands, view: View, options: argparse.Namespace) -> Story:
    """The way of files into Blender: File > Import, and a .ply let fall on the view."""
    stage.chapter = "drop"
    splats = options.splats
    count = len(all_splats())
    yield from hands.move(*view.middle())
    with view.override():
        bpy.ops.wm.drop_import_file(
            "INVOKE_DEFAULT", directory=str(splats.parent), files=[{"name": splats.name}]
        )
    yield stage.pause(1.0)
    yield from hands.shoot("09_dropped")
    if len(all_splats()) == count:
        yield from hands.keys("g")
        yield stage.pause(1.0)
        yield from hands.shoot("10_drop_options")
        yield from hands.keys("Return")
        yield stage.soon(lambda: len(all_splats()) == count + 1)
    stage.check("a dropped file becomes a splat object", len(all_splats()) == count + 1, len(all_splats()))
    yield from hands.shoot("11_drop_done")


def leave_in_the_middle(stage: Stage, view: View) -> Story:
    """Another file is loaded while a job runs: the worker goes. Then Blender is closed during a job."""
    stage.chapter = "leave"
    splats = all_splats()[0]
    view.window.view_layer.objects.active = splats
    bpy.context.scene.gskin.splats = splats
    bpy.context.scene.gskin.seed = 7
    with view.override():
        bpy.ops.gskin.auto_skin("INVOKE_DEFAULT")
    yield running
    process = part("session.running_job").state.job.client._process
    yield stage.pause(1.0)
    asked = time.monotonic()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    yield stage.soon(lambda: process.poll() is not None, 5.0)
    stage.numbers["load_file_stops_worker_s"] = time.monotonic() - asked
    stage.check("loading another file stops the worker", process.poll() is not None)
    stage.check("and nothing is said to run", not running())
    yield 0.5
    splats = all_splats()[0]
    view.window.view_layer.objects.active = splats
    bpy.context.scene.gskin.splats = splats
    with view.override():
        bpy.ops.gskin.auto_skin("INVOKE_DEFAULT")
    yield running
    yield 1.5
    stage.check("a job runs when Blender is closed (the caller looks whether it dies)", running())


def look(view: View) -> None:
    """From the front, a little from the left and above."""
    space = view.space.region_3d
    space.view_perspective = "PERSP"
    space.view_location = (0.05, 0.0, 0.83)
    space.view_distance = 3.1
    direction = mathutils.Vector((0.55, -1.0, 0.22))
    space.view_rotation = direction.to_track_quat("Z", "Y")
    view.space.lens = 60


class Took(NamedTuple):
    """Seconds of a call: by the clock but for those in which others had all processors, and of processor time."""

    own: float
    busy: float


def timed(method: str, cls: Any) -> list[Took]:
    """What each call of a class's method takes from now on."""
    original, seconds = getattr(cls, method), []

    def measured(*arguments: Any) -> Any:
        started, busy, delay = time.perf_counter(), time.thread_time(), waited()
        try:
            return original(*arguments)
        finally:
            own = time.perf_counter() - started - (waited() - delay)
            seconds.append(Took(own, time.thread_time() - busy))

    # Blender looks at how many parameters a method names.
    if method == "modal":
        cls.modal = lambda self, context, event: measured(self, context, event)
    else:
        cls.draw = lambda self, context: measured(self, context)
    return seconds


def ended(job: Any) -> bool:
    return job.client._process.poll() is not None


def untouched(obj: Any) -> bool:
    """Splats as they were imported: no groups, no armature, no helper mesh."""
    meshes = [other for other in bpy.context.scene.objects if other.type == "MESH"]
    return not obj.vertex_groups and obj.find_armature() is None and meshes == [obj]


def describe(obj: Any) -> str:
    return f"{len(obj.vertex_groups)} groups, modifiers {[modifier.name for modifier in obj.modifiers]}"


def drawn_points(obj: Any) -> np.ndarray:
    """The splats' centres (N, 3) in the world as Blender's modifiers leave them."""
    display = part("scene.node_groups").find_display(obj)
    display.show_viewport = False
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    flat = np.empty(3 * len(evaluated.data.vertices))
    evaluated.data.vertices.foreach_get("co", flat)
    display.show_viewport = True
    matrix = np.array(obj.matrix_world)
    return flat.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def moved_as_computed(stage: Stage, splats: Any, before: np.ndarray, when: str) -> None:
    """The drawn splats have moved, and to where the rig's formulas put them."""
    drawn = drawn_points(splats)
    size = float(np.linalg.norm(np.ptp(before, axis=0)))
    moved = np.linalg.norm(drawn - before, axis=1)
    stage.check(f"splats follow the bones ({when})", moved.max() > 0.05 * size, f"up to {moved.max() / size:.0%}")
    wanted = part("scene.posing").posed_cloud(splats).means
    error = float(np.abs(drawn - wanted).max()) / size
    stage.numbers[f"{when}_error"] = error
    stage.check(f"to where numpy puts them ({when})", error < 1e-5, f"{error:.1e} of the size")


def main() -> None:
    """Read the arguments behind `--` and start."""
    parser = story_parser()
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--preset", default="draft")
    perform(story, parser)


if __name__ == "__main__":
    main()
