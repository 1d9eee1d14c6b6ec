# SPDX-License-Identifier: GPL-3.0-or-later
"""True splats in a real window: drawn, posed, hidden, undone, reloaded, failing; splat_pictures.py judges the pictures.

blender --python tests/window/splats.py -- --out DIR --splats FILE.ply [--capture FILE.ply --capture-rig RIG.glb]
"""

from __future__ import annotations

import argparse
import importlib
import shutil
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import bpy
import mathutils
import numpy as np
from addon import ADDON, part
from figure import TURNS, armature, distance_weights
from stage import Hands, Stage, Story, View, perform, story_parser

FRONT = (0.55, -1.0, 0.22)


class Studio:
    """A plain 3D view, and pictures of it with all that is needed to render the same elsewhere."""

    def __init__(self, stage: Stage, hands: Hands, view: View) -> None:
        self.stage, self.hands, self.view = stage, hands, view

    def plain(self) -> None:
        """No side bar, no overlays, no gizmos: splats on one colour."""
        space = self.view.space
        space.show_region_ui = space.show_region_toolbar = space.show_region_hud = space.show_gizmo = False
        space.overlay.show_overlays = False
        space.shading.type, space.shading.background_type = "SOLID", "VIEWPORT"
        space.shading.background_color = (0.2, 0.2, 0.2)

    def look(self, target: Any, distance: float, direction: Any = FRONT, *, parallel: bool = False) -> None:
        """From `direction` at a place `distance` metres away."""
        camera = self.view.space.region_3d
        camera.view_perspective = "ORTHO" if parallel else "PERSP"
        camera.view_location, camera.view_distance = target, distance
        camera.view_rotation = mathutils.Vector(direction).to_track_quat("Z", "Y")
        self.view.space.lens = 60

    def state(self) -> Any:
        """What the drawing keeps of this view."""
        return part("scene.viewport.view_state").view_state(self.view.region().as_pointer())

    def settled(self) -> Story:
        """Wait until the view is drawn as it is now."""
        sorter = part("scene.viewport.view_state").sorter
        for _ in range(3):
            self.view.area.tag_redraw()
            yield 0.4
            yield lambda: not sorter.is_busy() and not sorter.has_results()

    def own(self) -> np.ndarray:
        """The drawing's own pixels (H, W, 4), first row the upper one."""
        return part("scene.viewport.drawing").read_target(self.state().target)[::-1]

    def picture(self, name: str) -> Story:
        """A screenshot only."""
        yield from self.settled()
        yield from self.hands.shoot(name)

    def measure(self, name: str, objects: list[Any]) -> Story:
        """A screenshot, the drawing's own pixels, the camera, and the splats as numpy poses them."""
        yield from self.picture(name)
        camera, region = self.view.space.region_3d, self.view.region()
        clouds = [part("scene.posing").posed_cloud(obj) for obj in objects]
        columns = {
            column: np.concatenate([getattr(cloud, column) for cloud in clouds])
            for column in ("means", "quats", "scales", "opacities", "sh")
        }
        np.savez(
            self.stage.out / f"{name}.npz", own=self.own().astype(np.float16), view=np.array(camera.view_matrix),
            projection=np.array(camera.window_matrix), size=(region.height, region.width), **columns,
        )  # fmt: skip


def story(stage: Stage, options: argparse.Namespace) -> Story:
    """All chapters, one after the other."""
    view = View()
    studio = Studio(stage, Hands(options.out, view, stage.views), view)
    stage.chapter = "splats"
    yield 1.0
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    studio.plain()
    studio.look((0.0, 0.0, 0.83), 3.1)
    yield from studio.picture("s00_empty")
    yield from sample(stage, studio, options.splats)
    yield from hiding(stage, studio)
    yield from undo_and_reload(stage, studio, options.out)
    yield from several(stage, studio)
    yield from harmonics(stage, studio)
    if options.capture is not None:
        yield from capture(stage, studio, options)
    yield from failing(stage, studio)
    module = importlib.import_module("addon_utils")
    obj = bring(options.splats, up="z")
    yield from studio.settled()
    stage.check("a new object is drawn by the shader", drawn(obj))
    node = part("scene.node_builder")
    name, modifier = part("scene.display_inputs").BY_SHADER, part("scene.node_groups").find_display(obj)
    module.disable(ADDON)
    stage.check("turning the add-on off brings ellipsoids back", node.get_input(modifier, name) is False)
    yield from studio.hands.shoot("s90_off")


def bring(path: Path, **options: Any) -> Any:
    """Import splats as the only objects; all of them are drawn."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    window = bpy.context.window_manager.windows[0]
    with bpy.context.temp_override(window=window):
        assert bpy.ops.gskin.import_splats("EXEC_DEFAULT", True, filepath=str(path), **options) == {"FINISHED"}
    obj = next(obj for obj in bpy.data.objects if part("scene.splat_object").is_splat_object(obj))
    part("scene.node_groups").set_display(obj, "Viewport Limit", 1_000_000)
    return obj


def drawn(obj: Any) -> bool:
    return part("scene.viewport.switch").is_drawn(obj)


def sample(stage: Stage, studio: Studio, splats: Path) -> Story:
    """The demo's character at rest and posed, in perspective and without."""
    obj = bring(splats, up="z")
    yield from studio.measure("s01_rest", [obj])
    stage.check("imported splats are drawn by the shader", drawn(obj))
    stage.check("and nothing failed", not part("scene.viewport.switch").failure, part("scene.viewport.switch").failure)
    rig = armature()
    rig.hide_set(True)
    cloud = part("scene.splat_object").read_cloud(obj)
    part("scene.weights").write_weights(obj, rig, distance_weights(cloud.means, rig), list(TURNS))
    part("scene.posing").turn_bones(rig, TURNS)
    yield from studio.measure("s02_posed", [obj])
    studio.look((0.0, 0.0, 1.2), 1.3)
    yield from studio.measure("s03_posed_close", [obj])
    studio.look((0.0, 0.0, 0.83), 3.1, (1.0, -0.6, 0.3), parallel=True)
    yield from studio.measure("s04_orthographic", [obj])
    studio.look((0.0, 0.0, 0.83), 3.1)
    stage.numbers["redraw_kept_s"] = redraw_seconds(studio.view)


def hiding(stage: Stage, studio: Studio) -> Story:
    """Something before the splats hides them, something behind does not; bones in front stay; hidden is hidden."""
    obj = next(obj for obj in bpy.data.objects if drawn(obj))
    rig = next(obj for obj in bpy.data.objects if obj.type == "ARMATURE")
    direction = mathutils.Vector(FRONT).normalized()
    yield from studio.settled()
    before = studio.own()[..., 3]
    middle = before.shape[0] // 2, before.shape[1] // 2
    patch = slice(middle[0] - 8, middle[0] + 8), slice(middle[1] - 8, middle[1] + 8)
    stage.check("the splats cover the middle of the view", before[patch].min() > 0.9, before[patch].min())
    for way, place in (("before", 1.2), ("behind", -1.2)):
        center = mathutils.Vector((0, 0, 0.83)) + place * direction
        with studio.view.override():
            bpy.ops.mesh.primitive_uv_sphere_add(radius=0.2, location=center)
        sphere = bpy.context.view_layer.objects.active
        for overlays in (True, False):
            studio.view.space.overlay.show_overlays = overlays
            yield from studio.picture(f"s10_{way}_{'overlays' if overlays else 'clean'}")
            alpha = studio.own()[..., 3]
            good = alpha[patch].max() == 0 if way == "before" else np.abs(alpha[patch] - before[patch]).max() < 1e-2
            overlay = "with" if overlays else "no"
            stage.check(f"a sphere {way} the splats ({overlay} overlays)", good, alpha[patch].max())
        bpy.data.objects.remove(sphere)
    space = studio.view.space
    space.overlay.show_overlays, space.overlay.show_floor = True, False
    space.overlay.show_axis_x = space.overlay.show_axis_y = space.overlay.show_cursor = space.overlay.show_text = False
    with studio.view.override():
        bpy.ops.object.select_all(action="DESELECT")
    yield from studio.picture("s11_no_bones")
    rig.hide_set(False)
    rig.show_in_front, rig.data.display_type = True, "STICK"
    yield from studio.picture("s12_bones")
    rig.hide_set(True)
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    yield from studio.picture("s13_selected")
    studio.plain()
    obj.hide_set(True)
    yield from studio.picture("s14_hidden")
    obj.hide_set(False)
    yield from studio.picture("s15_shown")
    with studio.view.override():
        bpy.ops.object.select_all(action="DESELECT")
    with studio.view.override():
        bpy.ops.mesh.primitive_cube_add(size=0.01, location=(0, 0, -5))
    cube = bpy.context.view_layer.objects.active
    with studio.view.override():
        bpy.ops.view3d.localview(frame_selected=False)
    yield from studio.picture("s16_local_view_of_another")
    with studio.view.override():
        bpy.ops.view3d.localview(frame_selected=False)
    bpy.data.objects.remove(cube)
    studio.look((0.0, 0.0, 0.83), 3.1)
    yield from studio.settled()
    x, y = studio.view.middle()
    yield from studio.hands.click(x, y)
    yield stage.soon(obj.select_get, 5.0)
    stage.check("a click on the splats selects them", obj.select_get())
    yield from studio.hands.click(x - 300, y + 200)
    yield stage.soon(lambda: not obj.select_get(), 5.0)
    stage.check("a click beside them selects nothing", not obj.select_get())
    for way, place in (("behind", -1.2), ("before", 1.2)):
        center = mathutils.Vector((0, 0, 0.83)) + place * direction
        with studio.view.override():
            bpy.ops.mesh.primitive_uv_sphere_add(radius=0.2, location=center)
        sphere = bpy.context.view_layer.objects.active
        yield from studio.settled()
        yield from studio.hands.click(x, y)
        yield stage.soon(lambda sphere=sphere, way=way: (obj if way == "behind" else sphere).select_get(), 5.0)
        good = obj.select_get() == (way == "behind") and sphere.select_get() == (way == "before")
        stage.check(f"with a sphere {way} them a click selects what is seen", good)
        bpy.data.objects.remove(sphere)
    with studio.view.override():
        bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)


def undo_and_reload(stage: Stage, studio: Studio, out: Path) -> Story:
    """Control-Z and loading the file: the splats are drawn, and where they belong."""
    rig = next(obj for obj in bpy.data.objects if obj.type == "ARMATURE")
    with studio.view.override():
        bpy.ops.ed.undo_push(message="before")
    yield from studio.picture("s20_before")
    part("scene.posing").turn_bones(rig, {"head": (0, 0, -80), "upper_arm": (0, 70, 0)})
    with studio.view.override():
        bpy.ops.ed.undo_push(message="turned")
    yield from studio.picture("s21_turned")
    yield from studio.hands.move(*studio.view.middle())
    yield from studio.hands.keys("ctrl+z")
    yield 1.0
    yield from studio.picture("s22_undone")
    path = out / "splats.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    yield from studio.picture("s23_saved")
    obj = next(obj for obj in bpy.data.objects if part("scene.splat_object").is_splat_object(obj))
    stage.check("after saving the shader goes on", drawn(obj))
    node, groups = part("scene.node_builder"), part("scene.node_groups")
    other = shutil.copyfile(path, out / "splats_linked.blend")  # Blender refuses to link from the open file
    with bpy.data.libraries.load(str(other), link=True) as (there, into):
        into.objects = [name for name in there.objects if name == obj.name]
    linked = into.objects[0]
    good = node.get_input(groups.find_display(linked), part("scene.display_inputs").BY_SHADER) is False
    stage.check("a saved file has ellipsoids for those without the add-on", good)
    bpy.data.libraries.remove(linked.library)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    yield 1.0
    yield from studio.picture("s24_reloaded")


def several(stage: Stage, studio: Studio) -> Story:
    """Two objects that stand in one another are one picture."""
    first = next(obj for obj in bpy.data.objects if part("scene.splat_object").is_splat_object(obj))
    second = first.copy()
    bpy.context.scene.collection.objects.link(second)
    second.modifiers.clear()
    part("scene.node_groups").set_display(second, "Viewport Limit", 1_000_000)
    second.location, second.rotation_euler, second.scale = (0.15, 0.1, 0.05), (0.0, 0.2, 2.0), (0.9,) * 3
    yield from studio.measure("s30_two_objects", [first, second])
    stage.check("both are drawn", drawn(first) and drawn(second))
    bpy.data.objects.remove(second)


def harmonics(stage: Stage, studio: Studio) -> Story:
    """Made-up harmonics of degree 3, from several sides, at rest and posed, in perspective and orthographic."""
    obj = next(obj for obj in bpy.data.objects if part("scene.splat_object").is_splat_object(obj))
    cloud = part("scene.splat_object").read_cloud(obj, world=False)
    random = np.random.default_rng(4)
    sh = np.concatenate([cloud.sh[:, :1], random.normal(0, 0.25, (1, 15, 3)).repeat(cloud.count, axis=0)], axis=1)
    made = type(cloud)(means=cloud.means, quats=cloud.quats, scales=cloud.scales, opacities=cloud.opacities, sh=sh)
    weights = part("scene.weights").read_weights(obj)[0]
    for other in [other for other in bpy.data.objects if other.type == "MESH"]:
        bpy.data.objects.remove(other)
    colored = part("scene.splat_object").create_splat_object(made, "Harmonics")
    part("scene.node_groups").set_display(colored, "Viewport Limit", 1_000_000)
    rig = next(obj for obj in bpy.data.objects if obj.type == "ARMATURE")
    for bone in rig.pose.bones:
        bone.matrix_basis.identity()
    colored.rotation_euler = (0.0, 0.0, 0.7)
    views = {"left": (1.0, -0.6, 0.3), "right": (-1.0, -0.6, 0.3)}
    for name, direction in views.items():
        studio.look((0.0, 0.0, 0.83), 3.1, direction)
        yield from studio.measure(f"s40_harmonics_{name}", [colored])
    colored.rotation_euler = (0.0, 0.0, 0.0)
    part("scene.weights").write_weights(colored, rig, weights, list(TURNS))
    part("scene.posing").turn_bones(rig, TURNS)
    for name, direction in views.items():
        studio.look((0.0, 0.0, 0.83), 3.1, direction)
        yield from studio.measure(f"s41_harmonics_posed_{name}", [colored])
    studio.look((0.0, 0.0, 0.83), 3.1, views["left"], parallel=True)
    yield from studio.measure("s42_harmonics_orthographic", [colored])


def capture(stage: Stage, studio: Studio, options: argparse.Namespace) -> Story:
    """A real capture, front and face, at rest and posed."""
    obj = bring(options.capture, up="-y")
    front = (-1.0, 0.15, 0.1)
    views = {"front": ((-0.1, 0.0, 1.6), 6.2), "face": ((-0.1, 0.0, 2.8), 1.4)}
    for name, (target, distance) in views.items():
        studio.look(target, distance, front)
        yield from studio.measure(f"s50_capture_{name}", [obj])
        bpy.context.scene.gskin_draw_splats = False
        yield from studio.picture(f"s55_ellipsoids_{name}")  # for people: what it was before
        bpy.context.scene.gskin_draw_splats = True
    stage.numbers["capture_redraw_kept_s"] = redraw_seconds(studio.view)
    yield from timed(stage, studio, "capture")
    rig = part("scene.rig_files").import_armature(options.capture_rig)
    rig.hide_set(True)
    cloud, names = part("scene.splat_object").read_cloud(obj), [bone.name for bone in rig.data.bones]
    ends = [(rig.matrix_world @ bone.head_local, rig.matrix_world @ bone.tail_local) for bone in rig.data.bones]
    near = [np.exp(-8 * np.linalg.norm(cloud.means - np.array((head + tail) / 2), axis=1)) for head, tail in ends]
    weights = np.stack(near, axis=1)
    part("scene.weights").write_weights(obj, rig, weights / weights.sum(axis=1, keepdims=True), names)
    # About the world's axes, to whatever the bones are called: all of them, a little, one after the other.
    part("scene.posing").turn_bones(rig, dict.fromkeys(names, (4.0, 3.0, 6.0)))
    for name, (target, distance) in views.items():
        studio.look(target, distance, front)
        yield from studio.measure(f"s51_capture_posed_{name}", [obj])
    studio.look(*views["front"], front, parallel=True)
    yield from studio.measure("s52_capture_orthographic", [obj])


def failing(stage: Stage, studio: Studio) -> Story:
    """An error of the drawing is said, and ellipsoids are there; switching the setting tries again."""
    obj = next(obj for obj in bpy.data.objects if part("scene.splat_object").is_splat_object(obj))
    module, switch = part("scene.viewport.view_state"), part("scene.viewport.switch")
    draw_into = module.draw_into

    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("made up by the test")

    module.draw_into = broken
    studio.look((0.0, 0.0, 0.8), 3.0)
    studio.view.area.tag_redraw()
    yield lambda: not drawn(obj)
    stage.check("an error of the drawing is kept for the panel", "made up by the test" in switch.failure)
    yield from studio.picture("s80_failed")
    module.draw_into = draw_into
    bpy.context.scene.gskin_draw_splats = False
    bpy.context.scene.gskin_draw_splats = True
    yield from studio.settled()
    stage.check("and another try draws", drawn(obj) and not switch.failure)
    yield from studio.picture("s81_again")


def timed(stage: Stage, studio: Studio, name: str) -> Story:
    """Seconds of the parts of a redraw after a turn of the view, where nothing can be kept."""
    handler = part("scene.viewport.handler")
    draw, seconds = handler._draw, []

    def measured(context: Any) -> None:
        began = time.perf_counter()
        draw(context)
        seconds.append(time.perf_counter() - began)

    handler._draw = measured
    camera = studio.view.space.region_3d
    whole = []
    for _ in range(5):
        camera.view_rotation = mathutils.Quaternion((0, 0, 1), 0.05) @ camera.view_rotation
        seconds.clear()
        whole.append(redraw_seconds(studio.view, 1))
        stage.numbers[f"{name}_draw_handler_s"] = max(seconds, default=0.0)
        yield from studio.settled()
    handler._draw = draw
    stage.numbers[f"{name}_redraw_turned_s"] = float(np.median(whole))


def redraw_seconds(view: View, times: int = 5) -> float:
    """Seconds of one redraw of the window's 3D view."""
    with view.override():
        began = time.perf_counter()
        bpy.ops.wm.redraw_timer(type="DRAW", iterations=times)
        return (time.perf_counter() - began) / times


def main() -> None:
    """Read the arguments behind `--` and start."""
    parser = story_parser()
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--capture-rig", type=Path)
    perform(story, parser)


main()
