# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer Weights: from a skinned mesh or other splats to the splats, and from the splats to a mesh."""

from __future__ import annotations

from typing import Any

import bpy
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.transfer.match import ANGLE, REACH
from ..scene.bone_frames import armature_of
from ..scene.proxy_object import followed_armature
from ..scene.splat_object import is_splat_object
from ..scene.steps import Steps
from ..scene.weight_edits import selected_splats, shows_selection
from ..scene.weight_transfer import Options, Report, iter_transfer_to_mesh, iter_transfer_to_splats, source_armature
from ..session.chosen import chosen_armature, chosen_splats, panel_settings
from ._weight_edit import WeightEdit

Array = NDArray[Any]


class _Transfer(WeightEdit):
    """What both directions share: options of the match, and what is said at the end."""

    reach: bpy.props.FloatProperty(
        name="Reach",
        description="How far away the weights may come from, as a share of the source's size (the diagonal of its "
        "bounding box); what finds nothing there is filled in from around it",
        default=REACH,
        min=0.001,
        max=1.0,
        subtype="FACTOR",
    )
    angle: bpy.props.FloatProperty(
        name="Angle",
        description="How far both surfaces may face apart, in degrees, so that a hand does not get the weights of the "
        "thigh behind it; 180 for any",
        default=ANGLE,
        min=1.0,
        max=180.0,
    )
    inpaint: bpy.props.BoolProperty(
        name="Fill In",
        description="What has no match in reach takes the weights that pass most smoothly between those around it; "
        "off, those of what is nearest",
        default=True,
    )

    leaves_edit_mode = True

    fit: bpy.props.BoolProperty(
        name="Fit First",
        description="Bring the source onto the target first, by a small turn, move and scale, for this transfer alone. "
        "For the same surface that is a little off; not for a body under clothes",
        default=False,
    )

    _report: Report | None = None

    def how(self) -> Options:
        """The options as the scene layer takes them."""
        return Options(self.reach, self.angle, self.inpaint, self.fit)

    def words(self) -> str:
        return "" if self._report is None else self._report.words()

    def counted(self, steps: Steps[Report]) -> Steps[int]:
        """The same steps; the report is kept for `words`."""
        self._report = yield from steps
        return self._report.changed


class GSKIN_OT_transfer_weights(_Transfer, bpy.types.Operator):
    """Give the splats the weights of the other selected object: a skinned mesh, or splats of the same character.
    Both must be in the same place at rest; bones are matched by their names. Locked groups stay"""

    bl_idname = "gskin.transfer_weights"
    bl_label = "Transfer Weights"

    source: bpy.props.StringProperty(
        name="From",
        description="The object to take the weights from; left empty: the other one that is selected",
        search=lambda self, context, text: [obj.name for obj in _sources(context) if text.lower() in obj.name.lower()],
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Select splats, and the object to take weights from")
            return False
        if not _sources(context):
            cls.poll_message_set("There is no other object with vertex groups; select it along with the splats")
            return False
        return True

    def steps(
        self, context: bpy.types.Context, splats: bpy.types.Object, there: bpy.types.Object, selected: Array | None
    ) -> Steps[int]:
        source = self._source(context, splats)
        armature = armature_of(splats) or source_armature(source) or chosen_armature(context)
        if armature is None:
            raise InputError(f"Neither '{splats.name}' nor '{source.name}' follows an armature; select one with them.")
        if armature_of(splats) is None:
            selected = None  # all get their first weights
        paintable = panel_settings(context).paintable
        return self.counted(
            iter_transfer_to_splats(source, splats, armature, selected, options=self.how(), paintable=paintable)
        )

    def _source(self, context: bpy.types.Context, splats: bpy.types.Object) -> bpy.types.Object:
        known = [obj for obj in _sources(context) if obj != splats]
        found = [obj for obj in known if (obj.name == self.source if self.source else obj.select_get())]
        if len(found) == 1:
            return found[0]
        if self.source:
            raise InputError(f"'{self.source}' is no object with vertex groups; choose one that has weights.")
        raise InputError(
            "Select one object with vertex groups along with the splats, or choose it as From."
            if not found
            else "Several objects with vertex groups are selected; choose one as From."
        )


class GSKIN_OT_transfer_weights_to_mesh(_Transfer, bpy.types.Operator):
    """Give the selected mesh the weights of the splats, as vertex groups, and let it follow their armature. Both must
    be in the same place at rest. Locked groups of the mesh stay"""

    bl_idname = "gskin.transfer_weights_to_mesh"
    bl_label = "Transfer Weights to Mesh"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or followed_armature(splats) is None:
            cls.poll_message_set("Select splats that follow an armature, and a mesh")
            return False
        if _mesh(context) is None:
            cls.poll_message_set("Select one mesh along with the splats")
            return False
        if splats.mode == "EDIT" or _mesh(context).mode == "EDIT":
            cls.poll_message_set("Leave Edit Mode (Tab)")
            return False
        return True

    def steps(
        self, context: bpy.types.Context, splats: bpy.types.Object, there: bpy.types.Object, selected: Array | None
    ) -> Steps[int]:
        mesh = _mesh(context)
        chosen = selected_splats(mesh) if shows_selection(mesh) else None
        return self.counted(iter_transfer_to_mesh(splats, mesh, chosen, options=self.how()))

    def done(self, count: int) -> str:
        return f"Weights of {count:,} vertices changed"


def _sources(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Objects of the view layer that may have weights to give."""
    splats = chosen_splats(context)
    return [obj for obj in context.view_layer.objects if obj.type == "MESH" and obj.vertex_groups and obj != splats]


def _mesh(context: bpy.types.Context) -> bpy.types.Object | None:
    """The only mesh that is selected besides splats."""
    found = [obj for obj in context.view_layer.objects.selected if obj.type == "MESH" and not is_splat_object(obj)]
    return found[0] if len(found) == 1 else None


CLASSES = (GSKIN_OT_transfer_weights, GSKIN_OT_transfer_weights_to_mesh)
