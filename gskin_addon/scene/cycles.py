# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture of a splat object by Cycles, framed like the rasteriser's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np

from ..core.files import replaced
from ..core.render.camera import EVALUATION_AZIMUTHS, orbit_views, percentile_bounds
from .posing import posed_cloud
from .render import render_still


def render_view(
    obj: bpy.types.Object,
    path: Path,
    view: str,
    size: int,
    background: Sequence[float],
    *,
    front: Sequence[float] = (0.0, -1.0, 0.0),
) -> None:
    """Render the scene as it is, from one of EVALUATION_AZIMUTHS, to a size x size PNG; background sRGB (3,).

    Changes camera, world and render settings of the scene, which is meant to be thrown away.
    """
    lower, upper = percentile_bounds(posed_cloud(obj).means)
    (view_camera,) = orbit_views(lower, upper, size, [EVALUATION_AZIMUTHS[view]], front=front, margin=0.06)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("GSkin View", bpy.data.cameras.new("GSkin View"))
    scene.collection.objects.link(camera)
    # Blender's cameras look along -z with y up; ours along z with y down.
    matrix = np.eye(4)
    matrix[:3, :3] = view_camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = view_camera.center
    camera.matrix_world = mathutils.Matrix(matrix.tolist())
    camera.data.angle = 2 * np.arctan(0.5 * size / view_camera.fx)
    camera.data.clip_end = 10 * float(np.linalg.norm(view_camera.translation))
    scene.camera = camera

    world = bpy.data.worlds.new("GSkin View")
    rgb = np.asarray(background, float)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    world.use_nodes = True
    color: Any = world.node_tree.nodes["Background"].inputs["Color"]
    color.default_value = (*linear.tolist(), 1.0)
    scene.world = world
    with replaced(path, ".png") as temporary:
        render_still(scene, temporary, size=(size, size))
