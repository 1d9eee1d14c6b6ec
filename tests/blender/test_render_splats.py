# SPDX-License-Identifier: GPL-3.0-or-later
"""Render Splats: the scene's camera, posed harmonics, what stands before the splats, files, and going on."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from bpy_extras.object_utils import world_to_camera_view
from mathutils import Euler, Vector

import gskin_addon
from gskin_addon import cli
from gskin_addon.commands.render_camera import parse_frames
from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.render import fragments
from gskin_addon.core.render.frame import draw_frame
from gskin_addon.core.render.output import write_picture
from gskin_addon.core.render.view_order import view_colors
from gskin_addon.core.splats.sh import eval_sh
from gskin_addon.core.worker.frame_pipe import pack_frame, read_frames
from gskin_addon.scene.drawn import bare, read_drawn, rendered_splats
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.scene_camera import scene_camera
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import write_weights
from gskin_addon.session import render_job
from gskin_addon.session.render_job import RenderJob

SIZE = (72, 48)


@pytest.fixture(autouse=True)
def scene(tmp_path):
    """An empty scene with a camera that looks at the origin, PNG of 16 bits, transparent, without a world."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.location, camera.rotation_euler = (0.0, -4.0, 0.0), (np.pi / 2, 0.0, 0.0)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *SIZE, 100
    render.film_transparent = True
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    render.image_settings.color_depth = "16"
    render.filepath = str(tmp_path / "out" / "frame_####")
    return scene


def shiny_cloud(count=200, seed=0):
    """Splats whose harmonics of degree 3 make them look different from every side."""
    rng = np.random.default_rng(seed)
    cloud = clouds.random_cloud(count, 3, seed=seed)
    sh = rng.normal(0, 0.35, (count, 16, 3)).astype(np.float32)
    means = rng.normal(0, 0.5, (count, 3)).astype(np.float32)
    scales = np.exp(rng.normal(-2.3, 0.4, (count, 3))).astype(np.float32)
    return replace(cloud, means=means, scales=scales, sh=sh, opacities=np.full(count, 0.8, np.float32))


def loaded(path):
    """The numbers (H, W, 4) of an image as they are in the file, its upper row first."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
    pixels = np.empty(image.channels * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], image.channels)[::-1]


class InThisProcess:
    """As `FrameClient`, without the seconds that a process needs to load numba."""

    def __init__(self, python, **options):
        self.drawn = []

    def draw(self, *message):
        pipe = io.BytesIO(b"".join(pack_frame(*message)))
        for number, frame, output in read_frames(pipe):
            write_picture(*draw_frame(frame), output)
            self.drawn.append({"stage": "drawn", "number": number})

    def poll(self):
        return [self.drawn.pop()] if self.drawn else []

    def stop(self):
        pass


def job(scene, **options):
    chosen = {"animation": False, "hold_out": True, "depth": False} | options
    return RenderJob.start(scene, bpy.context.view_layer, Path(sys.executable), **chosen)


def rendered(scene, **options):
    """Render to the end; the sentence."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render_job, "FrameClient", InThisProcess)
        running = job(scene, **options)
    try:
        running.wait(lambda event: None)
    finally:
        sentence = running.close()
    return sentence


def expected(cloud, camera):
    """The cloud with its own, turned coefficients by the reference: (color, alpha)."""
    torch = pytest.importorskip("torch")
    from gskin_addon.core.render import reference

    rays = np.broadcast_to(camera.forward, cloud.means.shape) if camera.orthographic else cloud.means - camera.center
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    arrays = cloud.means, cloud.quats, cloud.scales, eval_sh(cloud.sh, rays.astype(np.float32)), cloud.opacities
    image, alpha = reference.render(*map(torch.tensor, arrays), camera, torch.zeros(3))
    return image.numpy(), alpha.numpy()


def decibels(a, b):
    return -10 * np.log10(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2))


def test_the_scenes_camera_sees_points_where_blender_sees_them(scene):
    camera = scene.camera
    camera.rotation_euler, camera.scale = Euler((1.3, 0.2, 0.4)), (2.0, 2.0, 2.0)
    camera.location = (1.0, -4.0, 1.5)
    lens = camera.data
    points = np.random.default_rng(1).normal(0, 0.8, (20, 3))
    for kind in ("PERSP", "ORTHO"):
        for fit in ("AUTO", "VERTICAL"):
            for size, aspect in ((SIZE, (1.0, 1.0)), ((40, 90), (1.0, 1.7)), ((64, 48), (1.5, 1.0))):
                lens.type, lens.sensor_fit, lens.shift_x, lens.shift_y, lens.lens = kind, fit, 0.13, -0.21, 41.0
                scene.render.resolution_x, scene.render.resolution_y = size
                scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
                bpy.context.view_layer.update()
                ours, far = scene_camera(scene, bpy.context.evaluated_depsgraph_get())
                pixels, depth = ours.project(points)
                for point, pixel, z in zip(points, pixels, depth, strict=True):
                    view = world_to_camera_view(scene, camera, Vector(point))
                    # Blender's function knows nothing of pixel aspect beyond the frame's own shape.
                    assert z == pytest.approx(view.z, abs=1e-4)
                    wanted = (view.x * ours.width, (1 - view.y) * ours.height)
                    np.testing.assert_allclose(pixel, wanted, atol=2e-2)
                assert far == pytest.approx(lens.clip_end)


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("pose", [False, True])
def test_harmonics_turn_with_bones_and_with_the_object(scene, kind, pose):
    scene.camera.data.type, scene.camera.data.ortho_scale = kind, 3.0
    cloud = shiny_cloud()
    obj = create_splat_object(cloud, "S")
    rigs.place(obj, (0.2, 0.1, -0.1), (0.4, -0.3, 0.9), 1.1)
    if pose:
        rng = np.random.default_rng(2)
        armature = rigs.make_chains(4, rng)
        write_weights(obj, armature, rigs.random_weights(cloud, 4, rng))
        rigs.random_pose(armature, rng)
    rendered(scene)
    picture = loaded(scene.render.frame_path(frame=scene.frame_current))
    camera, _ = scene_camera(scene, bpy.context.evaluated_depsgraph_get())
    color, alpha = expected(posed_cloud(obj), camera)
    assert alpha.max() > 0.5
    assert decibels(picture[..., 3], alpha) > 60
    straight = color / np.maximum(alpha, 1e-6)[..., None]
    seen = alpha > 0.05
    assert decibels(picture[seen][:, :3], straight[seen]) > 55
    # Without the turns the picture is another one.
    with bare([obj]):
        bpy.context.view_layer.update()
        drawn = read_drawn(obj, bpy.context.view_layer.depsgraph)
    assert (drawn.turns is not None) == pose
    if pose:
        eye = np.append(np.linalg.inv(drawn.matrix)[:3, 3], 1.0)
        assert np.abs(view_colors(drawn, eye) - view_colors(replace(drawn, turns=None), eye)).mean() > 0.05


def test_the_display_is_on_again_and_the_scene_is_at_its_frame(scene):
    obj = create_splat_object(shiny_cloud(30), "S")
    scene.frame_start, scene.frame_end, scene.frame_current = 1, 3, 2
    sentence = rendered(scene, animation=True)
    assert find_display(obj).show_viewport
    assert scene.frame_current == 2
    assert "3 frames" in sentence
    assert sorted(p.name for p in Path(scene.render.filepath).parent.iterdir()) == [
        f"frame_{number:04d}.png" for number in (1, 2, 3)
    ]


def test_frames_that_are_there_are_kept_unless_overwritten(scene):
    create_splat_object(shiny_cloud(30), "S")
    scene.frame_start, scene.frame_end = 1, 2
    first = Path(scene.render.frame_path(frame=1))
    first.parent.mkdir()
    first.write_bytes(b"kept")
    scene.render.use_overwrite = False
    assert "1 were there already" in rendered(scene, animation=True)
    assert first.read_bytes() == b"kept"
    assert Path(scene.render.frame_path(frame=2)).stat().st_size > 100
    scene.render.use_overwrite = True
    rendered(scene, animation=True)
    assert first.read_bytes() != b"kept"


def test_a_cancelled_animation_leaves_no_placeholder_and_stops_at_once(scene):
    create_splat_object(shiny_cloud(30), "S")
    scene.frame_start, scene.frame_end = 1, 50
    scene.render.use_placeholder = True
    running = job(scene, animation=True)
    running.step()
    assert Path(scene.render.frame_path(frame=1)).stat().st_size == 0
    running.cancel()
    with pytest.raises(Cancelled):
        running.step()
    assert "Nothing was rendered" in running.close()
    running.client.close()
    assert not list(Path(scene.render.filepath).parent.iterdir())


def cube_before(scene, right_half):
    """A large cube between the camera and the right or left half of the picture."""
    bpy.ops.mesh.primitive_cube_add(size=2.0, location=(1.0 if right_half else -1.0, -2.0, 0.0))
    return bpy.context.object


def test_other_objects_hide_splats_to_the_pixel(scene):
    create_splat_object(shiny_cloud(400), "S")
    rendered(scene)
    free = loaded(scene.render.frame_path(frame=1))
    cube_before(scene, True)
    rendered(scene)
    hidden = loaded(scene.render.frame_path(frame=1))
    middle = SIZE[0] // 2
    assert free[:, middle:, 3].max() > 0.5
    assert not hidden[:, middle:, 3].any()
    np.testing.assert_array_equal(hidden[:, :middle], free[:, :middle])
    rendered(scene, hold_out=False)
    np.testing.assert_array_equal(loaded(scene.render.frame_path(frame=1)), free)


def test_what_is_off_for_renders_hides_nothing_and_shows_nothing(scene):
    obj = create_splat_object(shiny_cloud(100), "S")
    cube_before(scene, True).hide_render = True
    other = create_splat_object(shiny_cloud(10), "T")
    other.hide_render = True
    assert rendered_splats(bpy.context.view_layer) == [obj]
    rendered(scene)
    assert loaded(scene.render.frame_path(frame=1))[:, SIZE[0] // 2 :, 3].max() > 0.5


def test_an_opaque_film_has_the_worlds_colour_but_behind_what_hides(scene):
    create_splat_object(shiny_cloud(20), "S")
    cube_before(scene, True)
    scene.render.film_transparent = False
    scene.world = bpy.data.worlds.new("World")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.1, 0.0, 1.0)
    rendered(scene)
    picture = loaded(scene.render.frame_path(frame=1))
    np.testing.assert_allclose(picture[0, 0], (0.7354, 0.3492, 0.0, 1.0), atol=1e-3)
    assert picture[SIZE[1] // 2, -5, 3] == 0.0


@pytest.mark.parametrize("depth", ["16", "32"])
def test_an_exr_is_linear_premultiplied_and_has_the_depth(scene, depth):
    create_splat_object(shiny_cloud(), "S")
    rendered(scene)
    png = loaded(scene.render.frame_path(frame=1))
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = depth
    rendered(scene, depth=True)
    path = Path(scene.render.frame_path(frame=1))
    linear = np.where(png[..., :3] <= 0.04045, png[..., :3] / 12.92, ((png[..., :3] + 0.055) / 1.055) ** 2.4)
    seen = loaded(path)
    np.testing.assert_allclose(seen[..., 3], png[..., 3], atol=2e-3)
    inside = (png[..., :3] < 0.999).all(-1)  # PNG ends at 1
    np.testing.assert_allclose(seen[inside][:, :3], (linear * png[..., 3:])[inside], atol=2e-3)
    assert b"Z\0" in path.read_bytes()[:400]


def test_the_depth_beside_a_png_is_along_the_cameras_axis(scene):
    cloud = shiny_cloud(1)
    cloud = replace(cloud, means=np.array([[0.0, 1.0, 0.0]]), scales=np.full((1, 3), 0.4), opacities=np.ones(1))
    create_splat_object(cloud, "S")
    rendered(scene, depth=True)
    path = Path(scene.render.frame_path(frame=1))
    depth = loaded(path.with_name(f"{path.stem}_depth.exr"))[..., 0]
    assert depth[SIZE[1] // 2, SIZE[0] // 2] == pytest.approx(5.0, abs=1e-4)
    assert depth[0, 0] == pytest.approx(1e10)


def test_the_graphics_card_draws_what_hides_but_no_depth(scene, monkeypatch):
    """There is no card here: what it would be asked for, and that the rest goes to the processor with a word."""
    asked = []
    monkeypatch.setattr(render_job, "drawn_by_shader", lambda frame: asked.append(frame) or frame)
    create_splat_object(shiny_cloud(40), "S")
    bpy.ops.mesh.primitive_cube_add(location=(0.0, -1.0, 0.0))
    sentence = rendered(scene, on_gpu=True)
    assert len(asked) == 1
    assert len(asked[0].triangles) == 12
    assert "processor" not in sentence
    sentence = rendered(scene, on_gpu=True, depth=True)
    assert len(asked) == 1
    assert "by the processor, as the graphics card tells no depth" in sentence


def test_compiling_is_said(scene):
    create_splat_object(shiny_cloud(5), "S")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render_job, "FrameClient", InThisProcess)
        running = job(scene)
    try:
        assert running.step()
        running.client.drawn.append({"stage": "compiling"})
        assert running.step()
        assert running.progress.message == "Compiling what draws, once"
    finally:
        running.close()


def test_other_formats_are_written_by_blender_as_captured(scene):
    create_splat_object(shiny_cloud(), "S")
    rendered(scene)
    png = loaded(scene.render.frame_path(frame=1))
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "TIFF", "RGBA", "8"
    assert scene.view_settings.view_transform != "Standard"
    rendered(scene)
    tiff = loaded(scene.render.frame_path(frame=1))
    np.testing.assert_allclose(tiff[..., 3], png[..., 3], atol=3e-3)
    seen = png[..., 3] > 0.3
    assert decibels(tiff[seen][:, :3], png[seen][:, :3]) > 40


def test_what_cannot_be_rendered_is_said_in_a_sentence(scene):
    with pytest.raises(InputError, match="No splats are visible"):
        job(scene)
    create_splat_object(shiny_cloud(5), "S")
    scene.camera.data.type = "PANO"
    with pytest.raises(InputError, match="'Camera' is panoramic"):
        job(scene)
    scene.camera = None
    with pytest.raises(InputError, match="has no camera"):
        job(scene)


def test_the_operator_renders_without_a_window(scene):
    gskin_addon.register()
    try:
        create_splat_object(shiny_cloud(20), "S")
        assert bpy.ops.gskin.render_splats() == {"FINISHED"}
    finally:
        gskin_addon.unregister()
    assert loaded(scene.render.frame_path(frame=1))[..., 3].max() > 0.5


def test_both_rasterisers_are_the_same_picture(scene):
    still = pytest.importorskip("gskin_addon.core.render.cpu.still")
    cloud = shiny_cloud(300)
    create_splat_object(cloud, "S")
    camera, _ = scene_camera(scene, bpy.context.evaluated_depsgraph_get())
    splats = cloud.means, cloud.quats, cloud.scales, cloud.base_colors(), cloud.opacities
    ours, theirs = fragments.draw(*splats, camera), still.draw(*splats, camera)
    assert decibels(ours.color, theirs.color) > 90


def test_the_command_renders_from_the_scenes_camera(scene, tmp_path):
    create_splat_object(shiny_cloud(50), "S")
    scene.frame_start, scene.frame_end = 1, 40
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    common = ["render", str(tmp_path / "scene.blend"), "--view", "camera"]
    assert cli.main([*common, "--out", str(tmp_path / "still.exr"), "--depth"]) == 0
    still = loaded(tmp_path / "still.exr")
    assert still.shape[:2] == SIZE[::-1]
    assert still[..., 3].max() > 0.5
    (tmp_path / "walk_0002.png").write_bytes(b"kept")
    assert cli.main([*common, "--out", str(tmp_path / "walk_####.png"), "--frames", "1-5x2", "--resume"]) == 0
    assert sorted(path.name for path in tmp_path.glob("walk*")) == [f"walk_000{k}.png" for k in (1, 2, 3, 5)]
    assert (tmp_path / "walk_0002.png").read_bytes() == b"kept"


@pytest.mark.parametrize("wrong", ["a-b", "5-1", "1-5x0", "-"])
def test_frames_that_are_none_are_refused(wrong):
    with pytest.raises(InputError, match="names no frames"):
        parse_frames(wrong)
