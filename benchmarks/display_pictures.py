# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of rigged splats side by side, and how far each is from the rasteriser's: for docs/display.md.

    python -m benchmarks.display_pictures RIGGED.blend --out docs/images/display_NAME.jpg [--front=-x] [--close]
        [--rotate BONE X Y Z]... [--cycles SIZE]

Columns: what `gskin render` draws, *Render Splats* in numpy, and with --cycles the ellipsoid display by Cycles in that
size and 4 samples. Rows: the whole figure, and with --close its head.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from gskin_addon.commands.pose import parse_turns
from gskin_addon.core.job.settings import FRONTS
from gskin_addon.core.render.camera import Camera, look_at, orbit_views, percentile_bounds
from gskin_addon.core.render.picture import to_linear, to_srgb
from gskin_addon.core.render.rasterizer import prepare, render_cloud, view_colors
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.worker.frame_client import FrameClient
from gskin_addon.scene.display_inputs import NATIVE
from gskin_addon.scene.drawn import rendered_splats
from gskin_addon.scene.node_builder import has_input
from gskin_addon.scene.node_groups import find_display, renew_display, set_display
from gskin_addon.scene.posing import posed_cloud, turn_bones
from gskin_addon.scene.proxy_object import followed_armature
from gskin_addon.scene.render import render_still
from gskin_addon.session import render_job

SIZE = 800
WHITE = (1.0, 1.0, 1.0)


def main() -> None:
    """Make the pictures, print the agreement."""
    options = _options()
    bpy.ops.wm.open_mainfile(filepath=str(options.source.absolute()))
    scene, view_layer = bpy.context.scene, bpy.context.view_layer
    obj = rendered_splats(view_layer)[0]
    renew_display(obj)
    if has_input(find_display(obj), NATIVE):
        set_display(obj, NATIVE, False)
    armature = followed_armature(obj)
    if armature is not None:
        armature.animation_data_clear()
        for bone in armature.pose.bones:
            bone.matrix_basis = mathutils.Matrix()
        turn_bones(armature, parse_turns(options.rotate))
    view_layer.update()
    cloud = posed_cloud(obj)
    lower, upper = percentile_bounds(cloud.means)
    front = np.array(FRONTS[options.front])
    cameras = {"front": orbit_views(lower, upper, SIZE, [20.0], front=front, margin=0.06)[0]}
    if options.close:
        head = np.array([*(0.5 * (lower + upper))[:2], upper[2] - 0.06 * (upper[2] - lower[2])])
        aside = np.cross((0.0, 0.0, 1.0), front)
        eye = head + 0.3 * (upper[2] - lower[2]) * (front - 0.35 * aside)
        cameras["close"] = look_at(eye, head, size=SIZE)
    rows = []
    for name, camera in cameras.items():
        _place(scene, camera)
        wanted, _ = render_cloud(cloud, camera, WHITE)
        own = _render_splats(scene, view_layer)
        print(f"{name}: Render Splats {_decibels(own, wanted):.1f} dB", flush=True)
        row = [wanted, own]
        if options.cycles:
            shot = _by_cycles(scene, options.cycles)
            small = camera.resized(options.cycles)
            blended, linear = render_cloud(cloud, small, WHITE)[0], _blended_linearly(cloud, small)
            figures = f"{_decibels(shot, blended):.1f} dB, {_decibels(shot, linear):.1f} dB to a linear blend"
            print(f"{name}: Cycles, {options.cycles} px: {figures}", flush=True)
            row.append(np.kron(shot, np.ones((SIZE // options.cycles,) * 2 + (1,)))[:SIZE, :SIZE])
        rows.append(np.concatenate([image[:, SIZE // 8 : -SIZE // 8] for image in row], axis=1))
    _write_jpeg(options.out, np.concatenate(rows)[::2, ::2])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--front", choices=tuple(FRONTS), default="-y")
    parser.add_argument("--close", action="store_true")
    parser.add_argument("--rotate", action="append", nargs=4, default=[], metavar=("BONE", "X", "Y", "Z"))
    parser.add_argument("--cycles", type=int, default=0, metavar="SIZE", help="a divisor of 800")
    return parser.parse_args()


def _place(scene: Any, camera: Camera) -> None:
    """Let the scene's camera be this one, before a white world."""
    obj = bpy.data.objects.new("View", bpy.data.cameras.new("View"))
    scene.collection.objects.link(obj)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0]), camera.center
    obj.matrix_world = mathutils.Matrix(matrix.tolist())
    lens: Any = obj.data
    lens.angle = 2 * np.arctan(0.5 * camera.width / camera.fx)
    scene.camera = obj
    world: Any = bpy.data.worlds.new("White")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    scene.world = world


def _render_splats(scene: Any, view_layer: Any) -> NDArray[Any]:
    render = scene.render
    render.resolution_x = render.resolution_y = SIZE
    render.resolution_percentage, render.film_transparent = 100, False
    settings = render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "16"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "own.png"
        began = time.monotonic()
        job = render_job.RenderJob.start(
            scene, view_layer, Path(sys.executable), animation=False, hold_out=False, depth=False, out=path
        )
        assert isinstance(job.client, FrameClient)
        job.wait(lambda event: None)
        print(f"  {time.monotonic() - began:.1f} s with the start of the process", flush=True)
        job.close()
        return _read(path)


def _by_cycles(scene: Any, size: int) -> NDArray[Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cycles.png"
        render_still(scene, path, size=(size, size), samples=4)
        return _read(path)


def _blended_linearly(cloud: SplatCloud, camera: Camera) -> NDArray[Any]:
    """The picture as Blender blends it: in linear light, encoded afterwards."""
    colors = to_linear(np.clip(view_colors(cloud, camera), 0.0, 1.0))
    scene = prepare(cloud.scales, colors, cloud.opacities, backend="cpu")
    return to_srgb(scene.forward(cloud.means, cloud.quats, camera, WHITE).image)


def _read(path: Path) -> NDArray[Any]:
    image: Any = bpy.data.images.load(str(path))
    image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
    pixels = np.empty(image.channels * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], image.channels)[::-1, :, :3]


def _decibels(image: NDArray[Any], wanted: NDArray[Any]) -> float:
    return float(-10 * np.log10(max(np.mean((image - wanted) ** 2), 1e-12)))


def _write_jpeg(path: Path, srgb: NDArray[Any]) -> None:
    height, width = srgb.shape[:2]
    image: Any = bpy.data.images.new("Sheet", width, height)
    image.pixels.foreach_set(np.concatenate([srgb, np.ones((height, width, 1))], 2)[::-1].astype(np.float32).ravel())
    image.filepath_raw, image.file_format = str(path.absolute()), "JPEG"
    image.save(quality=82)


if __name__ == "__main__":
    main()
