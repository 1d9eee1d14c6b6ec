# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's camera as one of ours: lens, sensor, shift, resolution and pixel aspect as Blender renders with them."""

from __future__ import annotations

import bpy
import numpy as np

from ..core.errors import InputError
from ..core.render.camera import Camera


def image_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height in pixels of what the scene renders."""
    render = scene.render
    share = render.resolution_percentage / 100
    return max(1, int(render.resolution_x * share)), max(1, int(render.resolution_y * share))


def scene_camera(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> tuple[Camera, float]:
    """The camera of the scene at the present frame, and where its view ends, metres.

    Raises InputError where the scene has no camera, or one of a kind that no plane pictures.
    """
    obj = scene.camera
    if obj is None or obj.type != "CAMERA":
        raise InputError(f"Scene '{scene.name}' has no camera; add one (Add > Camera) and try again.")
    evaluated = obj.evaluated_get(depsgraph)
    lens: bpy.types.Camera = evaluated.data  # type: ignore[assignment]
    if lens.type not in ("PERSP", "ORTHO"):
        raise InputError(f"Camera '{obj.name}' is panoramic; choose Perspective or Orthographic as its type.")
    width, height = image_size(scene)
    render = scene.render
    projection = np.array(
        obj.calc_matrix_camera(
            depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
        ),
        np.float64,  # newer mathutils come as float32
    )
    # Blender's cameras look along -z with y up, ours along z with y down; their scale has no effect.
    world = evaluated.matrix_world.normalized()
    rotation = (np.array(world, np.float64)[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
    translation = -rotation @ np.array(world)[:3, 3]
    parallel = lens.type == "ORTHO"
    # Where the axis of the view meets the image: the shift is in the fourth column where rays are parallel.
    shift = projection[:2, 3] if parallel else -projection[:2, 2]
    camera = Camera(
        rotation=rotation,
        translation=translation,
        fx=0.5 * width * projection[0, 0],
        fy=0.5 * height * projection[1, 1],
        cx=0.5 * width * (1.0 + shift[0]),
        cy=0.5 * height * (1.0 - shift[1]),
        width=width,
        height=height,
        near=max(float(lens.clip_start), 1e-6),
        orthographic=parallel,
    )
    return camera, float(lens.clip_end)
