# SPDX-License-Identifier: GPL-3.0-or-later
"""What Moves With This: a click on a splat colours all others by how alike they move."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..scene import names
from ..scene.attributes import read_attribute
from ..scene.bone_frames import armature_of
from ..scene.cleanup import out_of_edit_mode
from ..scene.handlers import iter_settle
from ..scene.overlay import show_moves_with
from ..scene.selecting import active_splat, posed_points, selected_now
from ..scene.steps import Steps
from ..scene.viewport import switch
from ..session.chosen import chosen_splats
from ._sliced import Sliced

NEAR = 10
"""Pixels around the mouse in which splats count as clicked."""
SOLID = 0.3
"""Opacity from which on a splat is seen."""


class GSKIN_OT_show_moves_with(Sliced, bpy.types.Operator):
    """Colour all splats by how alike they move with one: click it; in Edit Mode, with the splat clicked last or with
    those selected"""

    bl_idname = "gskin.show_moves_with"
    bl_label = "What Moves with This"
    bl_options = {"REGISTER", "UNDO"}

    splat: bpy.props.IntProperty(
        name="Splat", description="Number of the splat; -1: those selected", default=-1, min=-1, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or armature_of(splats) is None:
            cls.poll_message_set("Select splats that follow an armature")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        splats = chosen_splats(context)
        self.asked = True
        if bpy.app.background or context.window is None or splats.mode in {"EDIT", "WEIGHT_PAINT"}:
            return self.execute(context)
        context.window.cursor_modal_set("EYEDROPPER")
        if context.workspace is not None:
            context.workspace.status_text_set("Click a splat  (Esc cancels)")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self._timer is not None:
            return super().modal(context, event)  # a splat is found
        if event.type in {"ESC", "RIGHTMOUSE"}:
            self._stop_picking(context)
            return {"CANCELLED"}
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}  # whoever looks for a splat turns the view
        self._stop_picking(context)
        found = self._clicked(context, event)
        if found is None:
            self.report({"WARNING"}, "There is no splat under the mouse")
            return {"CANCELLED"}
        self.splat = found
        return self.begin(context, modal=True)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.begin(context)

    def work(self, context: bpy.types.Context) -> Steps[str]:
        splats = chosen_splats(context)
        if self.splat >= 0:
            if self.splat >= len(splats.data.vertices):
                raise InputError(f"'{splats.name}' has no splat {self.splat}; the last is number "
                                 f"{len(splats.data.vertices) - 1}.")  # fmt: skip
            meant: Any = np.array([self.splat])
        else:
            active = active_splat(splats)
            meant = None if active is None else np.array([active])
        mode = splats.mode
        works = mode in {"EDIT", "WEIGHT_PAINT"}
        seen = works and switch.shows_overlay_in(splats, mode)
        leaves = mode == "EDIT" or (works and not seen)  # else the fabric is seen, and no splats
        with out_of_edit_mode(context, splats) if leaves else nullcontext():
            yield 0.0
            if meant is None:
                meant = selected_now(splats)
            yield from iter_settle(splats)
            count = show_moves_with(splats, meant)
        if leaves and seen:
            bpy.ops.object.mode_set(mode=mode)
        return f"{count:,} splats share at least half of their weights"

    def _stop_picking(self, context: bpy.types.Context) -> None:
        context.window.cursor_modal_restore()
        if context.workspace is not None:
            context.workspace.status_text_set(None)

    def _clicked(self, context: bpy.types.Context, event: bpy.types.Event) -> int | None:
        for area in context.screen.areas:
            for region in area.regions:
                at = event.mouse_x - region.x, event.mouse_y - region.y
                inside = 0 <= at[0] < region.width and 0 <= at[1] < region.height
                if area.type == "VIEW_3D" and region.type == "WINDOW" and inside:
                    space: Any = area.spaces.active
                    camera = space.region_3d
                    size = region.width, region.height
                    return clicked_splat(chosen_splats(context), camera.perspective_matrix, at, size)
        return None


def clicked_splat(splats: bpy.types.Object, matrix: Any, at: tuple[float, float], size: tuple[int, int]) -> int | None:
    """The splat nearest to the eye among those within `NEAR` pixels of a place of the picture; None where none is.

    matrix (4, 4): world to clip space; at: from the lower left; size: (width, height).
    """
    points = posed_points(splats)
    m = np.array(matrix, np.float64)
    clip = points @ m[:3, :3].T + m[:3, 3]
    w = points @ m[3, :3] + m[3, 3]
    base: NDArray[Any] | None = read_attribute(splats.data, names.BASE)
    solid = np.ones(len(points), np.bool_) if base is None else base[:, 3] >= SOLID
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (clip[:, :2] / w[:, None] + 1) / 2 * np.array(size)
    near = np.flatnonzero((w > 0) & solid & (np.linalg.norm(pixel - np.array(at), axis=1) <= NEAR))
    if not len(near):
        return None
    depth = (points[near] @ m[2, :3] + m[2, 3]) / w[near]  # grows with the way, whether rays are parallel or not
    return int(near[np.argmin(depth)])


CLASSES = (GSKIN_OT_show_moves_with,)
