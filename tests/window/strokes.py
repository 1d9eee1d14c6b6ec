# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own weight tools on splats, by mouse and keyboard: brushes, gradient, masks, undo; then ours.

blender --python tests/window/strokes.py -- --out DIR --splats FILE.ply --rig RIG

Mouse: strokes, gradient, box selection, our buttons in the side bar. Keys: Sample, Set Weight, Linked, undo, redo, Edit
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
from bpy_extras.view3d_utils import location_3d_to_region_2d
from session import find_rig, find_splats, part, rest, running
from stage import Hands, Stage, Story, View, Wait

TRIES = 3
"""Drags of the gradient, until one changes weights: on a loaded machine single ones did not arrive."""

PAUSE = 0.5
"""Seconds that Blender's main thread may be busy at a time, whatever is done."""
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
    stage.chapter = "arrive"
    yield 1.0
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    open_panel()
    view.space.show_region_ui, view.space.show_region_hud = True, False
    yield 0.8
    view.region("UI").active_panel_category = "GSkin"
    yield from hands.drag((view.region("UI").x, view.middle()[1]), (view.region("UI").x - 60, view.middle()[1]))
    yield from skin(stage, hands, view, options)
    painting = Painting(stage, hands, view, options.bone, options.locked)
    yield from enter(stage, painting)
    yield from brushes(stage, painting)
    yield from gradient_and_set(stage, painting)
    yield from masks(stage, painting)
    yield from leave(stage, painting)
    yield from edit_mode(stage, painting)
    yield from our_buttons(stage, painting)
    stage.chapter = "end"


def open_panel() -> None:
    """The panel of the weights is shut at first; here it is open as if somebody had clicked on its head before."""
    panel = bpy.types.GSKIN_PT_weights
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()
    bpy.utils.register_class(panel)


def skin(stage: Stage, hands: Hands, view: View, options: argparse.Namespace) -> Story:
    """Splats and rig come in, the default job runs, the figure is posed and seen from the front."""
    stage.chapter = "skin"
    with view.override():
        bpy.ops.gskin.import_splats("EXEC_DEFAULT", True, filepath=str(options.splats), up=options.up)
    rig = part("scene.rig_files").import_armature(options.rig)
    rest(rig)
    rig.show_in_front, rig.data.display_type = True, "STICK"
    chosen = bpy.context.scene.gskin
    chosen.splats, chosen.armature, chosen.guidance = find_splats(), rig, "none"
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in (find_splats(), rig))
    view.window.view_layer.objects.active = find_splats()
    camera = view.space.region_3d
    camera.view_perspective = "ORTHO"
    camera.view_rotation = mathutils.Vector(options.front).to_track_quat("Z", "Y")
    with view.override():
        bpy.ops.view3d.view_selected()
        bpy.ops.ed.undo_push(message="Bring in splats and armature")
    yield stage.pause(1.0)
    stage.chapter = "job"
    with view.override():
        bpy.ops.gskin.auto_skin("INVOKE_DEFAULT")
    yield running
    yield lambda: not running()
    stage.chapter = "skinned"
    yield stage.pause(1.0)
    splats = find_splats()
    stage.numbers["splats"] = len(splats.data.vertices)
    stage.check("Auto-Skin lays a fabric", part("scene.fabric").has_fabric(splats), f"{len(splats.data.polygons):,}")
    part("scene.posing").turn_bones(rig, {options.bone: (0, 12, 8)})
    rig.select_set(False)
    splats.vertex_groups[options.locked].lock_weight = True
    bpy.context.tool_settings.use_auto_normalize = True
    with view.override():
        bpy.ops.ed.undo_push(message="Pose")
    yield from hands.shoot("k00_posed")


def enter(stage: Stage, painting: Painting) -> Story:
    """Weight Paint shows the weights of the active bone on the posed figure."""
    stage.chapter = "enter"
    painting.choose(painting.bone)
    took = yield from switch(stage, painting, "WEIGHT_PAINT")
    stage.numbers["enter Weight Paint s"] = took
    pauses(stage, "enter", "enter Weight Paint")
    display = part("scene.node_groups").find_display(painting.splats)
    stage.check("in Weight Paint the display makes way for the fabric", not display.show_viewport)
    yield from painting.hands.shoot("k01_weight_paint")


def pauses(stage: Stage, chapter: str, what: str, *, ours: bool = False) -> None:
    """Note how long Blender stood still in a chapter at most: by the clock, but for what others took, and busy."""
    stage.numbers[f"{what}: longest pause s"] = max(stage.own_gaps(chapter), default=0.0)
    busy = stage.numbers[f"{what}: longest busy s"] = max(stage.busy(chapter), default=0.0)
    if ours:  # modes and strokes are Blender's own work, and that of drawing without a graphics card
        stage.check_time(f"{what}: no long pause", busy, PAUSE, stage.pace.busy(*stage.chapter_times(chapter)))


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
    pauses(stage, "brushes", "strokes")


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
    yield settled(stage, painting)
    stage.check("rotations follow what was painted", turned_as_computed(painting.splats))
    display = part("scene.node_groups").find_display(painting.splats)
    stage.check("the display is back", display.show_viewport)
    pauses(stage, "leave", "leave Weight Paint")
    yield from painting.hands.shoot("k05_back")


def edit_mode(stage: Stage, painting: Painting) -> Story:
    """Tab, a box on the posed figure, Linked, and back."""
    stage.chapter = "edit"
    yield from painting.keys("Tab")
    yield stage.soon(lambda: painting.splats.mode == "EDIT", 8.0)
    yield stage.pause(0.5)
    pauses(stage, "edit", "enter Edit Mode")
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


def our_buttons(stage: Stage, painting: Painting) -> Story:
    """To Bone and Smooth on the selection in Edit Mode, then Mirror on all, by clicks in the side bar."""
    stage.chapter = "buttons"
    found = yield from painting.view.find_buttons(painting.hands, "gskin.")
    wanted = {"To Bone": "gskin.assign_to_bone", "Smooth": "gskin.smooth_weights", "Mirror": "gskin.mirror_weights"}
    yield from painting.hands.shoot("k07_buttons")
    column = painting.names.index(painting.bone)
    for name, operator in wanted.items():
        stage.check(f"the button {name} is found", operator in found, found.get(operator))
        if operator not in found:
            continue
        if name == "Mirror":
            yield from painting.keys("Tab")
            yield stage.soon(lambda: painting.splats.mode == "OBJECT", 8.0)
        before, mode = read_outside(painting), painting.splats.mode
        selected = part("scene.weight_edits").selected_splats(painting.splats)
        stage.chapter = f"button {name}"
        began = time.monotonic()
        yield from painting.hands.click(*found[operator])
        yield stage.soon(working, 5.0)
        yield lambda: not working()
        stage.numbers[f"{name} s"] = time.monotonic() - began
        # Leaving and entering Edit Mode takes Blender itself about as long.
        pauses(stage, f"button {name}", name, ours=mode == "OBJECT")
        stage.chapter = "buttons"
        # Where the machine is busy the click may come later than was waited for.
        yield stage.soon(lambda before=before: not working() and (read_outside(painting) != before).any(), 30.0)
        after = read_outside(painting)
        changed = (after != before).any(axis=1)
        stage.check(f"{name} changes splats", changed.any(), f"{changed.sum():,} in {painting.splats.mode}")
        stage.check(f"{name}: the mode stays", painting.splats.mode == mode)
        stage.check(f"{name}: sums stay 1", np.abs(after[changed].sum(axis=1) - 1).max(initial=0) < 1e-3)
        locked = painting.names.index(painting.locked)
        stage.check(f"{name}: the locked group stays", np.array_equal(after[:, locked], before[:, locked]))
        if name != "Mirror":
            stage.check(f"{name} keeps to the selection", not changed[~selected].any())
        if name == "To Bone":
            free = after[selected, column] + after[selected, locked]
            stage.check("To Bone gives all that is not locked to the bone", np.abs(free - 1).max() < 1e-3)
        yield settled(stage, painting)
    stage.chapter = "buttons"
    if painting.splats.mode == "EDIT":
        yield from painting.keys("Tab")
        yield settled(stage, painting)
    stage.check("rotations follow our tools", turned_as_computed(painting.splats))
    yield from painting.hands.shoot("k08_end")


def working() -> bool:
    """Whether an operator of ours says in the status bar that it works."""
    window = bpy.context.window_manager.windows[0]
    return any(operator.bl_idname.startswith("GSKIN_OT") for operator in window.modal_operators)


def read_outside(painting: Painting) -> np.ndarray:
    """The weights, also while Edit Mode is open."""
    splats = painting.splats
    if splats.mode != "EDIT":
        return painting.weights()
    splats.update_from_editmode()
    pairs = part("scene.vertex_groups").read_pairs(splats, slice(0, len(splats.data.vertices)))
    out = np.zeros((len(splats.data.vertices), len(painting.names)), np.float32)
    place = {name: number for number, name in enumerate(painting.names)}
    column = np.array([place.get(group.name, -1) for group in splats.vertex_groups])
    ours = column[pairs[1]] >= 0
    out[pairs[0][ours], column[pairs[1][ours]]] = pairs[2][ours]
    return out


def settled(stage: Stage, painting: Painting) -> Wait:
    """Wait until the new weights turn the splats. Computing turns meanwhile would keep the slices waiting."""
    return stage.soon(lambda: not part("scene.handlers").is_unsettled(painting.splats), 10.0)


def turned_as_computed(splats: Any) -> bool:
    """Whether the nodes turn the splats as the rig's formulas do with the weights that the splats have now."""
    if splats.mode != "OBJECT":
        return True
    wanted = part("scene.posing").posed_cloud(splats)
    display = part("scene.node_groups").find_display(splats)
    shown = display.show_viewport
    display.show_viewport = False
    mesh = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    quats = part("scene.attributes").read_attribute(mesh, "rotation")
    turn = np.array(splats.matrix_world.to_quaternion())
    display.show_viewport = shown
    if quats is None or len(quats) != wanted.count:
        return False
    w, x, y, z = turn
    a, b, c, d = quats.T
    world = np.stack([w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
                      w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], axis=1)  # fmt: skip
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    return bool(np.abs(np.einsum("nk,nk->n", world, wanted.quats)).min() > 1 - 1e-4)


def main() -> None:
    """Read the arguments after `--` and start."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--splats", type=Path, required=True)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--up", default="z")
    parser.add_argument("--bone", default="head")
    parser.add_argument("--locked", default="chest")
    parser.add_argument("--front", type=float, nargs=3, default=(0.0, -1.0, 0.0))
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :])
    bpy.context.preferences.view.show_splash = False
    stage = Stage(options.out)
    stage.play(story(stage, options))


if __name__ == "__main__":
    main()
