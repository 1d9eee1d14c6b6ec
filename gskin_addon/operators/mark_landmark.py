# SPDX-License-Identifier: GPL-3.0-or-later
"""Mark Landmark and Clear Landmarks: where a hand, a foot or the head of a body is, for Fit Human and the like."""

from __future__ import annotations

import bpy
import numpy as np

from ..core.skeleton.landmarks import NAMES
from ..scene.landmarks import add_landmark, read_landmarks, remove_landmarks
from ..scene.transforms import points_in_world
from ..scene.weight_edits import selected_splats
from ..session.chosen import chosen_splats

_TITLES = {"hand": "Hand", "foot": "Foot", "front_paw": "Front Paw", "hind_paw": "Hind Paw", "head": "Top of Head",
           "wing": "Wing", "beak": "Beak"}  # fmt: skip
_SIDES = {"L": "Left", "R": "Right", "": ""}


def _items() -> list[tuple[str, str, str]]:
    found = []
    for name in NAMES:
        kind, _, side = name.partition(".")
        title = f"{_SIDES[side]} {_TITLES[kind]}".strip()
        found.append((name, title, "Seen from the body itself" if side else ""))
    return found


class GSKIN_OT_mark_landmark(bpy.types.Operator):
    """Say where an end of the body is, for the next fit: in Edit Mode the middle of the selected splats, else the 3D
    cursor. Marked again, it moves"""

    bl_idname = "gskin.mark_landmark"
    bl_label = "Mark Landmark"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.EnumProperty(name="Landmark", description="Which end of the body it is", items=_items())

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Choose a splat object")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats = chosen_splats(context)
        if splats.mode == "EDIT":
            selected = selected_splats(splats)
            if not selected.any():
                self.report({"ERROR"}, f"No splats of '{splats.name}' are selected; select some at that end.")
                return {"CANCELLED"}
            points = np.empty(3 * len(selected), np.float32)
            splats.data.vertices.foreach_get("co", points)  # in Edit Mode attributes cannot be read
            place = points_in_world(points.reshape(-1, 3)[selected].astype(np.float64), splats).mean(axis=0)
        else:
            place = np.array(context.scene.cursor.location, np.float64)
        empty = add_landmark(splats, self.name, place)
        self.report({"INFO"}, f"'{empty.name}' is marked; fit the skeleton again")
        return {"FINISHED"}


class GSKIN_OT_clear_landmarks(bpy.types.Operator):
    """Take the landmarks of the splats away"""

    bl_idname = "gskin.clear_landmarks"
    bl_label = "Clear Landmarks"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or not read_landmarks(splats):
            cls.poll_message_set("Nothing is marked")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        count = remove_landmarks(chosen_splats(context))
        self.report({"INFO"}, f"{count} landmarks removed")
        return {"FINISHED"}


CLASSES = (GSKIN_OT_mark_landmark, GSKIN_OT_clear_landmarks)
