# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of the 3D view of a Blender that has no window here: the bpy module draws it off screen.

xvfb-run -a PYTHON tests/window/viewport.py --out DIR --splats FILE.ply      needs bpy >= 5.2 and OpenGL (Mesa)

The add-on is that of this repository. Writes empty.png, rest.png and posed.png: the view in Solid mode.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import bpy
import gpu
import mathutils
import numpy as np
from figure import TURNS, armature, distance_weights

import gskin_addon
from gskin_addon.scene.posing import posed_cloud, turn_bones
from gskin_addon.scene.splat_object import read_cloud
from gskin_addon.scene.weights import write_weights

SIZE = 600


class Camera:
    """The 3D view of the first screen, seen from the front, a little from the left and above."""

    def __init__(self, out: Path) -> None:
        self.out = out
        gpu.init()
        self.area = next(area for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D")
        self.space = self.area.spaces.active
        self.region = next(region for region in self.area.regions if region.type == "WINDOW")
        self.space.shading.type, self.space.overlay.show_overlays = "SOLID", False
        self.target = gpu.types.GPUOffScreen(SIZE, SIZE)
        # 2.2 wide at the character's place, as an orthographic view: x right, z up, y away.
        turn = mathutils.Euler((np.radians(80), 0, np.radians(25))).to_matrix().to_4x4()
        place = mathutils.Matrix.Translation((0, 0, 0.85))
        self.view = (place @ turn @ mathutils.Matrix.Translation((0, 0, 5))).inverted()
        self.projection = mathutils.Matrix.Diagonal((1 / 1.1, 1 / 1.1, -2 / 10, 1))
        self.projection[2][3] = -1.0

    def shoot(self, name: str) -> None:
        """Draw, and write `name`.png."""
        bpy.context.view_layer.update()
        self.target.draw_view3d(
            bpy.context.scene, bpy.context.view_layer, self.space, self.region, self.view, self.projection,
            do_color_management=True,
        )  # fmt: skip
        pixels = np.array(self.target.texture_color.read().to_list(), np.float32)
        pixels = pixels / 255.0 if pixels.max() > 1.0 else pixels
        image = bpy.data.images.new(name, SIZE, SIZE)
        image.pixels.foreach_set(np.ascontiguousarray(pixels).ravel())
        image.filepath_raw, image.file_format = str(self.out / f"{name}.png"), "PNG"
        image.save()
        bpy.data.images.remove(image)


def main() -> None:
    """Import, bind, pose, and a picture of each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--splats", type=Path, required=True)
    options = parser.parse_args()
    gskin_addon.register()
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    camera = Camera(options.out)
    camera.shoot("empty")
    assert bpy.ops.gskin.import_splats(filepath=str(options.splats)) == {"FINISHED"}
    splats: Any = bpy.context.view_layer.objects.active
    camera.space.shading.color_type = "VERTEX"
    camera.shoot("rest")
    rig = armature()
    rig.hide_set(True)
    write_weights(splats, rig, distance_weights(read_cloud(splats).means, rig), list(TURNS))
    turn_bones(rig, TURNS)
    assert np.isfinite(posed_cloud(splats).means).all()
    camera.shoot("posed")
    print(f"ok    {bpy.app.version_string}: the 3D view drawn off screen", flush=True)


try:
    main()
except BaseException:
    traceback.print_exc()
    os._exit(1)
# Python's own end crashes in the driver once Blender has drawn.
os._exit(0)
