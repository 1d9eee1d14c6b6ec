# SPDX-License-Identifier: GPL-3.0-or-later
"""Select splats by bone, by colour, linked, along the body, and as the view shows them."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.body_graph import BodyGraph
from ..core.skinning.edits.selection import by_color, grown, in_front, linked, shrunk, spacing
from ..scene.armature import deform_bone_names
from ..scene.bone_frames import armature_of, bone_order
from ..scene.handlers import iter_settle
from ..scene.influences import read_influences
from ..scene.rotation_nodes import frames_of
from ..scene.selecting import base_colors, iter_body_of, posed_points
from ..scene.steps import Steps, in_thread
from ..session.chosen import chosen_splats
from ._selecting import WAYS, SelectSplats
from ._weight_edit import bone_column, search_bones

Mask = NDArray[np.bool_]


class GSKIN_OT_select_by_bone(SelectSplats, bpy.types.Operator):
    """Select the splats that a bone moves: those with at least so much of its weight"""

    bl_idname = "gskin.select_by_bone"
    bl_label = "Select by Bone"

    bone: bpy.props.StringProperty(
        name="Bone",
        description="The bone; left empty: that of the active vertex group",
        search=search_bones,
    )
    least: bpy.props.FloatProperty(
        name="Weight From", description="The least weight", default=0.5, min=0.001, max=1.0, subtype="FACTOR"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or armature_of(splats) is None:
            cls.poll_message_set("Select splats that follow an armature")
            return False
        return True

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        bones = deform_bone_names(armature_of(splats))
        bone = bones[bone_column(splats, self.bone, bones)]
        yield from iter_settle(splats)
        frames, stored = frames_of(splats), read_influences(splats)
        if frames is None or stored is None:
            raise InputError(f"'{splats.name}' is not bound; click Bind Splats to Armature.")
        number = bone_order(frames).index(bone)
        return np.asarray(((stored[0] == number) * stored[1]).sum(axis=1) >= self.least)


class GSKIN_OT_select_by_color(SelectSplats, bpy.types.Operator):
    """Select the splats whose colour is like that of the splat clicked last, else the middle of the selected ones"""

    bl_idname = "gskin.select_by_color"
    bl_label = "Select by Color"

    tolerance: bpy.props.FloatProperty(
        name="Tolerance",
        description="How far colours may differ as eyes see them: 0.02 is just noticed, 1 is black against white",
        default=0.08,
        min=0.0,
        soft_max=0.5,
        max=2.0,
    )
    color: bpy.props.FloatVectorProperty(
        name="Color",
        description="The colour that is looked for; taken from the splats, and yours to change afterwards",
        size=3,
        min=0.0,
        max=1.0,
        subtype="COLOR_GAMMA",
        options={"SKIP_SAVE"},
    )

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        yield 0.0
        colors = base_colors(splats)
        if not self.properties.is_property_set("color"):
            if self.active is not None:
                self.color = colors[self.active]
            elif selected.any():
                self.color = np.median(colors[selected], axis=0)
            else:
                raise InputError(f"No splats of '{splats.name}' are selected; select one of the colour, or give it.")
        return by_color(colors, np.array(self.color), self.tolerance)


class GSKIN_OT_select_linked_splats(SelectSplats, bpy.types.Operator):
    """Select all splats that hang together with the selected ones; seams and gaps end it"""

    bl_idname = "gskin.select_linked_splats"
    bl_label = "Select Linked Splats"

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        _need(splats, selected)
        graph = yield from iter_body_of(splats)
        return (yield from in_thread(lambda: linked(graph, selected)))


class _AlongBody(SelectSplats):
    unit: bpy.props.EnumProperty(
        name="Unit",
        items=[
            ("SPACING", "Splats", "The usual way from a splat to the next"),
            ("LENGTH", "Length", "Metres, as the scene has them"),
        ],
    )
    steps: bpy.props.FloatProperty(
        name="Splats", description="So many times the usual way from a splat to the next", default=3.0, min=0.0,
        soft_max=50.0,
    )  # fmt: skip
    length: bpy.props.FloatProperty(
        name="Length", description="So far along the body", default=0.05, min=0.0, soft_max=1.0, unit="LENGTH"
    )

    change: Callable[[BodyGraph, Mask, float], Mask]
    """From the selection to another, by so many metres."""

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        _need(splats, selected)
        graph = yield from iter_body_of(splats)
        far = self.far(graph)
        return (yield from in_thread(lambda: self.change(graph, selected, far)))

    def far(self, graph: BodyGraph) -> float:
        """Metres."""
        return self.length if self.unit == "LENGTH" else self.steps * spacing(graph)

    def draw(self, context: bpy.types.Context) -> None:
        layout: bpy.types.UILayout = self.layout  # type: ignore[attr-defined]
        layout.use_property_split = True
        layout.prop(self, "unit", expand=True)
        layout.prop(self, "length" if self.unit == "LENGTH" else "steps")


class GSKIN_OT_grow_splat_selection(_AlongBody, bpy.types.Operator):
    """Select also what lies around the selected splats, along the body"""

    bl_idname = "gskin.grow_splat_selection"
    bl_label = "Grow Selection"

    change = staticmethod(grown)


class GSKIN_OT_shrink_splat_selection(_AlongBody, bpy.types.Operator):
    """Leave out what lies at the rim of the selection, along the body"""

    bl_idname = "gskin.shrink_splat_selection"
    bl_label = "Shrink Selection"

    change = staticmethod(shrunk)


class GSKIN_OT_select_in_front(SelectSplats, bpy.types.Operator):
    """Of the selected splats keep those that the view shows: what lies behind others is left out. So a box or lasso
    drawn through the figure becomes one of its front side"""

    bl_idname = "gskin.select_in_front"
    bl_label = "Front Side Only"

    mode: bpy.props.EnumProperty(
        name="Mode",
        description="What becomes of what is selected",
        items=WAYS,
        default="AND",
    )
    depth: bpy.props.FloatProperty(
        name="Depth",
        description="How deep below the surface splats still count, in times the usual way from a splat to the next",
        default=4.0,
        min=0.0,
        soft_max=50.0,
    )
    view: bpy.props.FloatVectorProperty(size=16, options={"HIDDEN", "SKIP_SAVE"})
    lens: bpy.props.FloatVectorProperty(size=16, options={"HIDDEN", "SKIP_SAVE"})

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        if not self.properties.is_property_set("view"):
            camera = _region_view(context)
            if camera is None:
                raise InputError("No 3D view is open from which splats could be seen; open one.")
            # The last operation is done again from the view that it was clicked in.
            self.view = np.array(camera.view_matrix).ravel()
            self.lens = np.array(camera.window_matrix).ravel()
        graph = yield from iter_body_of(splats)
        size = max(self.depth, 0.5) * spacing(graph)
        view, lens = np.array(self.view).reshape(4, 4), np.array(self.lens).reshape(4, 4)
        yield 0.5
        points = posed_points(chosen_splats(context))
        return (yield from in_thread(lambda: in_front(points, view, lens, size)))


def _region_view(context: bpy.types.Context) -> bpy.types.RegionView3D | None:
    if context.region_data is not None:
        return context.region_data
    for area in () if context.screen is None else context.screen.areas:
        if area.type == "VIEW_3D":
            space = area.spaces.active
            return space.region_3d if isinstance(space, bpy.types.SpaceView3D) else None
    return None


def _need(splats: bpy.types.Object, selected: Mask) -> None:
    if not selected.any():
        raise InputError(f"No splats of '{splats.name}' are selected; select some in Edit Mode (Tab).")


CLASSES = (
    GSKIN_OT_select_by_bone,
    GSKIN_OT_select_by_color,
    GSKIN_OT_select_linked_splats,
    GSKIN_OT_grow_splat_selection,
    GSKIN_OT_shrink_splat_selection,
    GSKIN_OT_select_in_front,
)
