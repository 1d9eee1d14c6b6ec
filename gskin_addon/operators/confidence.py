# SPDX-License-Identifier: GPL-3.0-or-later
"""Select Unsure Splats, Next Unsure Cluster: where automatic weights are most likely to need a hand."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.selection import worst_clusters
from ..scene import names
from ..scene.attributes import read_attribute
from ..scene.selecting import enter_edit_mode, iter_body_of
from ..scene.steps import Steps, in_thread
from ..session.chosen import chosen_splats
from ._selecting import SelectSplats, at_hand
from ._sliced import SlicedClick

Mask = NDArray[np.bool_]


class GSKIN_OT_select_unsure_splats(SelectSplats, bpy.types.Operator):
    """Select the splats whose automatic weights are the least sure, and show them in Edit Mode"""

    bl_idname = "gskin.select_unsure_splats"
    bl_label = "Select Unsure Splats"

    worst: bpy.props.FloatProperty(
        name="Least Sure",
        description="This part of the splats is selected, the least sure ones",
        default=5.0,
        min=0.0,
        max=100.0,
        precision=1,
        subtype="PERCENTAGE",
    )
    below: bpy.props.FloatProperty(
        name="And All Below",
        description="Splats less sure than this are selected in any case; 0 for none",
        default=0.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )

    _bound = ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return knows_confidence(cls, context)

    def find(self, context: bpy.types.Context, splats: bpy.types.Object, selected: Mask) -> Steps[Mask]:
        yield 0.0
        confidence = read_attribute(splats.data, names.CONFIDENCE)
        unsure = least(confidence, self.worst / 100) | (confidence < self.below)
        self._bound = f"none surer than {float(confidence[unsure].max(initial=0.0)):.0%}" if unsure.any() else ""
        return unsure

    def words(self) -> str:
        return self._bound


class GSKIN_OT_next_unsure_cluster(SlicedClick, bpy.types.Operator):
    """Select the next group of splats that hang together and are the least sure, the worst first, and show it in the
    3D view"""

    bl_idname = "gskin.next_unsure_cluster"
    bl_label = "Next Unsure Cluster"
    bl_options = {"REGISTER", "UNDO"}

    step: bpy.props.IntProperty(name="Step", default=1, options={"HIDDEN", "SKIP_SAVE"})
    worst: bpy.props.FloatProperty(
        name="Least Sure",
        description="This part of the splats counts as unsure",
        default=5.0,
        min=0.1,
        max=100.0,
        precision=1,
        subtype="PERCENTAGE",
    )
    number: bpy.props.IntProperty(
        name="Cluster", description="Which cluster; 1 is the worst", default=0, min=0, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return knows_confidence(cls, context)

    def work(self, context: bpy.types.Context) -> Steps[str]:
        splats = chosen_splats(context)
        uid = splats.data.session_uid
        with at_hand(context, splats) as there:
            yield 0.0
            confidence = read_attribute(there.data, names.CONFIDENCE)
            graph, share = (yield from iter_body_of(there)), self.worst / 100
            clusters = yield from in_thread(lambda: worst_clusters(graph, confidence, share))
            if not clusters:
                raise InputError(f"The least sure splats of '{splats.name}' form no groups; take a larger part.")
            if not self.number:
                self.number = (_last.get(uid, 0) + self.step - 1) % len(clusters) + 1
            self.number = min(self.number, len(clusters))
            rows = clusters[self.number - 1]
            mask = np.zeros(len(confidence), np.bool_)
            mask[rows] = True
            yield 1.0
        _last.clear()
        _last[uid] = self.number
        enter_edit_mode(context, splats, mask)
        _frame(context)
        return (
            f"Cluster {self.number} of {len(clusters)}: {len(rows):,} splats, {confidence[rows].mean():.0%} sure in "
            "the mean"
        )


_last: dict[int, int] = {}
"""The cluster shown last, by session id of the mesh."""


def _frame(context: bpy.types.Context) -> None:
    """Let the 3D views show what is selected."""
    for area in () if context.screen is None else context.screen.areas:
        region = next((region for region in area.regions if region.type == "WINDOW"), None)
        if area.type == "VIEW_3D" and region is not None:
            with context.temp_override(area=area, region=region):
                bpy.ops.view3d.view_selected()


def knows_confidence(operator: type[Any], context: bpy.types.Context) -> bool:
    """Whether the chosen splats know how sure their weights are; says so where not."""
    splats = chosen_splats(context)
    if splats is None or names.CONFIDENCE not in splats.data.attributes:
        operator.poll_message_set("Select splats with weights from Auto-Skin that know how sure they are")
        return False
    return True


def least(values: NDArray[Any], share: float) -> NDArray[np.bool_]:
    """Mask (N,) of the smallest of values (N,), `share` (0 to 1) of them; of equal ones the first."""
    mask = np.zeros(len(values), bool)
    mask[np.argsort(values, kind="stable")[: round(share * len(values))]] = True
    return mask


CLASSES = (GSKIN_OT_select_unsure_splats, GSKIN_OT_next_unsure_cluster)
