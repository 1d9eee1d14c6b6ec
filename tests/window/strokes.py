# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own weight tools on splats, by mouse and keyboard: brushes, gradient, masks, undo.

blender --python tests/window/strokes.py -- --out DIR --splats FILE.ply --rig RIG

Mouse: strokes, gradient, box selection. Keys: Sample, Set Weight, Linked, undo, redo, Edit
Mode. Called as a script calls them: which brush or tool is active (an asset shelf has no keys), Weight Paint, Smooth
and Levels of the menu Weights, and Select More and Less, whose keys are on a number pad that is not to be pressed here.
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
import numpy as np
from addon import find_rig, find_splats, part, turned_as_computed, unsettled
from arriving import arrive, auto_skin, bring_in, remember
from bpy_extras.view3d_utils import location_3d_to_region_2d
from stage import Hands, Stage, Story, View, perform, story_parser

TRIES = 3
"""Drags of the gradient, until one changes weights: on a loaded machine single ones did not arrive."""
BRUSHES = {"Paint": "builtin.brush", "Blur": "builtin_brush.blur", "Average": "builtin_brush.average",
           "Smear": "builtin_brush.smear"}  # fmt: skip


class Painting:
    """The splats, the bone that is painted, the one that is locked, and what a tool did to them."""

    def __init__(self, stage: Stage, hands: Hands, view: View, bone: str, locked: str) -> None:
        self.stage, self.hands, self.view, self.bone, self.locked = stage, hands, view, bone, locked
        self.drawn: list[float] = []
        self.names: list[str] = part("scene.armature").deform_bone_names(find_rig())
        bpy.types.SpaceView3D.draw_handler_add(self._drawn, (), "WINDOW", "POST_PIXEL")

    def _drawn(self) -> None:
        self.drawn.append(time.monotonic())

    @property
    def splats(self) -> Any:
        return find_splats()

    def weights(self) -> np.ndarray:
        """(N, B) as they are painted now."""
        return part("scene.weights").read_weights(self.splats, self.names)[0]

    def choose(self, bone: str) -> None:
        """Make the group of a bone the active one."""
        groups = self.splats.vertex_groups
        groups.active_index = groups.find(bone)

    def place(self, share: float, across: float = 0.0) -> tuple[int, int]:
        """Where on the screen a place along the painted bone is, and `across` pixels to the right of it."""
        rig = find_rig()
        bone = rig.pose.bones[self.bone]
        point = rig.matrix_world @ (bone.head * (1 - share) + bone.tail * share)
        region = self.view.region()
        x, y = location_3d_to_region_2d(region, self.view.space.region_3d, point)
        return round(region.x + x + across), round(self.view.window.height - region.y - y)

    def line(self) -> list[tuple[int, int]]:
        """A stroke along the bone, a little beside it."""
        return [self.place(share, 6 * share) for share in np.linspace(-0.4, 0.8, 8)]

    def judge(self, what: str, before: np.ndarray, *, sums: bool = True, least: int = 20) -> np.ndarray:
        """Check what a tool did; returns the splats (N,) that changed."""
        after = self.weights()
        changed = (after != before).any(axis=1)
        self.stage.numbers[f"{what} splats"] = int(changed.sum())
        self.stage.check(f"{what} changes splats", changed.sum() >= least, f"{changed.sum():,}")
        column = self.names.index(self.locked)
        # Where what is locked and what was asked for are more than 1 together, there is nothing left to normalise.
        possible = changed & (after[:, [column, self.names.index(self.bone)]].sum(axis=1) <= 1)
        if sums and changed.any():
            off = np.abs(after[possible].sum(axis=1) - 1).max(initial=0)
            self.stage.check(f"{what}: sums stay 1", off < 1e-3, f"{off:.1e} of {possible.sum():,}")
        self.stage.check(f"{what}: the locked group stays", np.array_equal(after[:, column], before[:, column]))
        return changed

    def there_and_back(self, what: str, before: np.ndarray) -> Story:
        """Control-Z takes it away, Control-Shift-Z brings it back; it is taken away in the end."""
        after, mode = self.weights(), self.splats.mode
        for word, keys, wanted in (("undo", "ctrl+z", before), ("redo", "ctrl+shift+z", after)):
            yield from self.keys(keys)
            yield self.stage.soon(lambda wanted=wanted: np.array_equal(self.weights(), wanted), 8.0)
            good = np.array_equal(self.weights(), wanted) and self.splats.mode == mode
            self.stage.check(f"{what}: {word}", good, self.splats.mode)

    def keys(self, *names: str) -> Story:
        """Keys with the mouse over the figure."""
        yield from self.hands.move(*self.place(0.5))
        yield from self.hands.keys(*names)
        yield self.stage.pause(0.4)

    def tool(self, name: str) -> None:
        """Make a tool of the tool bar the active one."""
        with self.view.override():
            bpy.ops.wm.tool_set_by_id(name=name)

    def brush_tool(self, name: str, tool: str) -> None:
        """Make a brush the active one; Debian's 4.3 comes without any, so that one is made."""
        self.tool(tool)
        if bpy.context.tool_settings.weight_paint.brush is not None and bpy.app.version >= (4, 5):
            return
        self.tool("builtin.brush")
        made = bpy.data.brushes.get(f"Test {name}") or bpy.data.brushes.new(f"Test {name}", mode="WEIGHT_PAINT")
        kind = "DRAW" if name == "Paint" else name.upper()
        setattr(made, "weight_tool" if hasattr(made, "weight_tool") else "weight_brush_type", kind)
        made.asset_mark()
        with self.view.override():
            bpy.ops.brush.asset_activate(
                asset_library_type="LOCAL", relative_asset_identifier=f"Brush/Test {name}"
            )

    def brush(self, **values: float) -> None:
        """Size (pixels), strength and weight of all brushes."""
        tools = bpy.context.tool_settings
        unified = getattr(tools.weight_paint, "unified_paint_settings", None) or tools.unified_paint_settings
        for name, value in values.items():
            if hasattr(unified, f"use_unified_{name}"):
                setattr(unified, f"use_unified_{name}", True)
            setattr(unified, name, value)
            setattr(tools.weight_paint.brush, name, value)

    def sampled(self) -> float:
        """The weight that the brush paints now."""
        tools = bpy.context.tool_settings
        unified = getattr(tools.weight_paint, "unified_paint_settings", None) or tools.unified_paint_settings
        return float(unified.weight if unified.use_unified_weight else tools.weight_paint.brush.weight)

    def select_none(self) -> None:
        with self.view.override():
            bpy.ops.paint.vert_select_all(action="DESELECT")

    def selected(self) -> int:
        return int(part("scene.weight_edits").selected_splats(self.splats).sum())


def story(stage: Stage, options: argparse.Namespace) -> Story:
    """All chapters."""
    view = View()
    hands = Hands(options.out, view, stage.views)
    yield from arrive(stage, hands, view)
    yield from skin(stage, hands, view, options)
    painting = Painting(stage, hands, view, options.bone, options.locked)
    yield from enter(stage, painting)
    yield from brushes(stage, painting)
    yield from gradient_and_set(stage, painting)
    yield from masks(stage, painting)
    yield from leave(stage, painting)
    yield from edit_mode(stage, painting)
    stage.chapter = "end"


def skin(stage: Stage, hands: Hands, view: View, options: argparse.Namespace) -> Story:
    """Splats and rig come in, the default job runs, the figure is posed and seen from the front."""
    stage.chapter = "skin"
    splats, rig = bring_in(view, options.splats, options.rig, options.up)
    rig.show_in_front, rig.data.display_type = True, "STICK"
    camera = view.space.region_3d
    camera.view_perspective = "ORTHO"
    camera.view_rotation = mathutils.Vector(options.front).to_track_quat("Z", "Y")
    with view.override():
        bpy.ops.view3d.view_selected()
    remember(view, "Bring in splats and armature")
    yield stage.pause(1.0)
    yield from auto_skin(stage, view)
    stage.numbers["splats"] = len(splats.data.vertices)
    stage.check("Auto-Skin lays a fabric", part("scene.fabric").has_fabric(splats), f"{len(splats.data.polygons):,}")
    part("scene.posing").turn_bones(rig, {options.bone: (0, 12, 8)})
    rig.select_set(False)
    splats.vertex_groups[options.locked].lock_weight = True
    bpy.context.tool_settings.use_auto_normalize = True
    remember(view, "Pose")
    yield from hands.shoot("k00_posed")


def enter(stage: Stage, painting: Painting) -> Story:
    """Weight Paint shows the weights of the active bone on the posed figure."""
    stage.chapter = "enter"
    painting.choose(painting.bone)
    took = yield from switch(stage, painting, "WEIGHT_PAINT")
    stage.numbers["enter Weight Paint s"] = took
    stage.note_pauses("enter", "enter Weight Paint")
    display = part("scene.node_groups").find_display(painting.splats)
    stage.check("in Weight Paint the display makes way for the fabric", not display.show_viewport)
    yield from painting.hands.shoot("k01_weight_paint")


def switch(stage: Stage, painting: Painting, mode: str) -> Any:
    """Change the mode; returns the seconds until it is drawn."""
    began = time.monotonic()
    with painting.view.override():
        bpy.ops.object.mode_set("EXEC_DEFAULT", True, mode=mode)  # True: with an undo step, as from the menu
    painting.view.area.tag_redraw()
    yield lambda: painting.drawn and painting.drawn[-1] > began
    took = time.monotonic() - began
    yield stage.pause(0.6)
    return took


def brushes(stage: Stage, painting: Painting) -> Story:
    """Each brush, one stroke down along the bone."""
    stage.chapter = "brushes"
    for name, tool in BRUSHES.items():
        painting.brush_tool(name, tool)
        yield stage.pause(0.5)
        painting.brush(size=40, strength=0.7, weight=0.6)
        before = painting.weights()
        began = time.monotonic()
        yield from painting.hands.stroke(painting.line())
        shown = [at for at in painting.drawn if at > painting.hands.pressed]
        if shown:
            stage.numbers[f"{name} shown s"] = shown[0] - painting.hands.pressed
        stage.numbers[f"{name} stroke s"] = time.monotonic() - began
        yield stage.pause(0.5)
        painting.judge(name, before)
        if name == "Paint":
            yield from painting.hands.shoot("k02_painted")
            yield from painting.there_and_back(name, before)
    stage.note_pauses("brushes", "strokes")


def gradient_and_set(stage: Stage, painting: Painting) -> Story:
    """The gradient tool, the weight under the cursor, Set Weight, and two of the menu Weights."""
    stage.chapter = "gradient"
    painting.brush_tool("Paint", BRUSHES["Paint"])
    painting.brush(weight=0.5, strength=1.0)
    painting.tool("builtin.gradient")
    yield stage.pause(1.0)
    before = painting.weights()
    for _ in range(TRIES):
        yield from painting.hands.drag(painting.place(0.0, 15), painting.place(1.0, 15))
        yield stage.pause(1.0)
        if (painting.weights() != before).any():
            break
    painting.judge("Gradient", before)
    yield from painting.there_and_back("Gradient", before)
    yield from painting.hands.shoot("k03_gradient")
    painting.brush_tool("Paint", BRUSHES["Paint"])
    painting.brush(weight=0.123)
    yield from painting.keys("shift+x")
    column = painting.weights()[:, painting.names.index(painting.bone)]
    sampled = painting.sampled()
    near = np.abs(column - sampled).min()
    stage.check("Sample takes the weight under the cursor", abs(sampled - 0.123) > 1e-4 and near < 0.02, sampled)
    before = painting.weights()
    with painting.view.override():
        bpy.ops.object.vertex_group_smooth(group_select_mode="ACTIVE", factor=0.5, repeat=3)
    painting.judge("Weights > Smooth", before, sums=False)
    before = painting.weights()
    with painting.view.override():
        bpy.ops.object.vertex_group_levels(group_select_mode="ACTIVE", offset=-0.05, gain=1.1)
    painting.judge("Weights > Levels", before, sums=False)
    with painting.view.override():
        bpy.ops.object.vertex_group_normalize_all(group_select_mode="ALL", lock_active=False)


def masks(stage: Stage, painting: Painting) -> Story:
    """Vertex selection: a box, more, less, linked; Set Weight on it alone."""
    stage.chapter = "masks"
    yield from painting.keys("2")
    stage.check("2 switches vertex selection on", painting.splats.data.use_paint_mask_vertex)
    painting.select_none()
    yield from painting.keys("b")
    x, y = painting.place(0.5)
    yield from painting.hands.drag((x - 40, y - 30), (x + 40, y + 30))
    yield stage.pause(0.5)
    boxed = painting.selected()
    stage.check("a box selects splats", 0 < boxed < len(painting.splats.data.vertices) / 2, f"{boxed:,}")
    before = painting.weights()
    painting.brush(weight=0.8)
    yield from painting.keys("ctrl+x")
    changed = painting.judge("Set Weight", before, sums=False)  # Blender's own does not normalise
    mask = part("scene.weight_edits").selected_splats(painting.splats)
    stage.check("Set Weight keeps to the mask", not changed[~mask].any())
    yield from painting.there_and_back("Set Weight", before)
    with painting.view.override():
        bpy.ops.paint.vert_select_more()
    more = painting.selected()
    stage.check("Select More adds neighbours", more > boxed, f"{boxed:,} to {more:,}")
    with painting.view.override():
        bpy.ops.paint.vert_select_less()
    less = painting.selected()
    stage.check("Select Less takes them away", less < more, f"{more:,} to {less:,}")
    yield from painting.hands.shoot("k04_mask")
    painting.select_none()
    yield from painting.keys("l")
    linked = painting.selected()
    stage.numbers["Linked splats"] = linked
    stage.check("Linked takes what hangs together", linked > 100, f"{linked:,}")
    yield from painting.keys("2")


def leave(stage: Stage, painting: Painting) -> Story:
    """Back in Object Mode splats are drawn again, turned as the new weights say."""
    stage.chapter = "leave"
    stage.numbers["leave Weight Paint s"] = yield from switch(stage, painting, "OBJECT")
    yield stage.soon(lambda: not unsettled(painting.splats), 10.0)
    stage.check("rotations follow what was painted", turned_as_computed(painting.splats))
    display = part("scene.node_groups").find_display(painting.splats)
    stage.check("the display is back", display.show_viewport)
    stage.note_pauses("leave", "leave Weight Paint")
    yield from painting.hands.shoot("k05_back")


def edit_mode(stage: Stage, painting: Painting) -> Story:
    """Tab, a box on the posed figure, Linked, and back."""
    stage.chapter = "edit"
    yield from painting.keys("Tab")
    yield stage.soon(lambda: painting.splats.mode == "EDIT", 8.0)
    yield stage.pause(0.5)
    stage.note_pauses("edit", "enter Edit Mode")
    stage.chapter = "edited"
    stage.check("Tab enters Edit Mode", painting.splats.mode == "EDIT")
    with painting.view.override():
        bpy.ops.mesh.select_all(action="DESELECT")
    yield from painting.keys("b")
    x, y = painting.place(0.5)
    yield from painting.hands.drag((x - 30, y - 30), (x + 30, y + 30))
    yield stage.pause(0.5)
    boxed = painting.selected()
    stage.check("a box in Edit Mode selects splats", boxed > 0, f"{boxed:,}")
    with painting.view.override():
        bpy.ops.mesh.select_more()
    stage.check("Select More in Edit Mode", painting.selected() > boxed, f"{painting.selected():,}")
    yield from painting.hands.shoot("k06_edit")


def main() -> None:
    """Read the arguments behind `--` and start."""
    parser = story_parser()
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--up", default="z")
    parser.add_argument("--bone", default="head")
    parser.add_argument("--locked", default="chest")
    parser.add_argument("--front", type=float, nargs=3, default=(0.0, -1.0, 0.0))
    perform(story, parser)


if __name__ == "__main__":
    main()
