# SPDX-License-Identifier: GPL-3.0-or-later
"""What all chapters of hands.py work with: the splats and their rig, the hands, the view and its buttons."""

from __future__ import annotations

from typing import Any

import bpy
import mathutils
import numpy as np
from addon import find_rig, find_splats, part, read_outside, unsettled
from arriving import choose
from bpy_extras.view3d_utils import location_3d_to_region_2d
from buttons import Buttons
from stage import Hands, Stage, Story, View


class Desk:
    """The stage, the hands, the view and its buttons, and the figure that is worked on."""

    def __init__(self, stage: Stage, hands: Hands, view: View) -> None:
        self.stage, self.hands, self.view = stage, hands, view
        self.buttons = Buttons(stage, hands, view)

    @property
    def splats(self) -> Any:
        return find_splats()

    @property
    def rig(self) -> Any:
        return find_rig()

    @property
    def bones(self) -> list[str]:
        return part("scene.armature").deform_bone_names(self.rig)

    def column(self, bone: str) -> int:
        """Of a bone in `weights`."""
        return self.bones.index(bone)

    def weights(self) -> np.ndarray:
        """(N, B) as they are now, in any mode."""
        return read_outside(self.splats, self.bones)

    def selected(self) -> np.ndarray:
        """(N,) which splats are selected, in any mode."""
        return part("scene.weight_edits").selected_splats(self.splats)

    def points(self) -> np.ndarray:
        """(N, 3) the splats' centres at rest in the world."""
        flat = np.empty(3 * len(self.splats.data.vertices), np.float32)
        self.splats.data.vertices.foreach_get("co", flat)
        matrix = np.array(self.splats.matrix_world)
        return flat.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]

    def value(self, name: str) -> np.ndarray | None:
        """(N,) a value of the splats, outside of Edit Mode; its name as in scene/names.py."""
        return part("scene.attributes").read_attribute(self.splats.data, getattr(part("scene.names"), name))

    def overlay(self) -> str:
        """What *Show* shows."""
        return part("scene.overlay").overlay_of(self.splats)

    def choose(self, bone: str) -> None:
        """Make the group of a bone the active one."""
        self.splats.vertex_groups.active_index = self.splats.vertex_groups.find(bone)

    def look(self, direction: tuple[float, float, float] = (0.0, -1.0, 0.0), *, at: Any = None) -> None:
        """Straight from a direction, at the whole figure, or closely at a place."""
        camera = self.view.space.region_3d
        camera.view_perspective = "ORTHO"
        camera.view_rotation = mathutils.Vector(direction).to_track_quat("Z", "Y")
        points = self.points()
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        camera.view_location = middle.tolist() if at is None else at
        camera.view_distance = float(np.ptp(points, axis=0).max()) * (1.5 if at is None else 0.5)
        camera.update()

    def place(self, point: Any) -> tuple[int, int]:
        """Where on the screen a place of the world is."""
        region = self.view.region()
        x, y = location_3d_to_region_2d(region, self.view.space.region_3d, mathutils.Vector(point))
        return round(region.x + x), round(self.view.window.height - region.y - y)

    def keys(self, *names: str) -> Story:
        """Keys, with the mouse over the view beside the figure."""
        left, _, _, lower = self.view.open_part()
        yield from self.hands.move(left + 40, lower - 40)
        yield from self.hands.keys(*names)
        yield self.stage.pause(0.4)

    def tab(self, mode: str) -> Story:
        """Into Edit Mode or out of it by Tab; nothing where the splats are in that mode."""
        if self.splats.mode == mode:
            return
        choose(self.view, self.splats, *([] if self.splats.find_armature() is None else [self.splats.find_armature()]))
        yield from self.keys("Tab")
        yield self.stage.soon(lambda: self.splats.mode == mode, 10.0)
        yield self.stage.pause(0.5)

    def box(self, point: Any, width: int, height: int) -> Story:
        """In Edit Mode: select nothing, then what is within so many pixels of a place, through the figure."""
        with self.view.override():
            bpy.ops.mesh.select_all(action="DESELECT")
        self.view.space.shading.show_xray = True
        yield from self.keys("b")
        x, y = self.place(point)
        yield from self.hands.drag((x - width, y - height), (x + width, y + height))
        yield self.stage.pause(0.5)
        self.view.space.shading.show_xray = False

    def settled(self) -> Story:
        """New weights turn the splats, and the view shows them."""
        yield self.stage.soon(lambda: not unsettled(self.splats), 10.0)
        self.view.area.tag_redraw()
        yield self.stage.pause(1.0)


def near(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(M,) the number of the point among others (K, 3) that each of points (M, 3) is nearest to."""
    return np.array([np.linalg.norm(others - point, axis=1).argmin() for point in points])
