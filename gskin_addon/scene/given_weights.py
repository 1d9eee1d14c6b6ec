# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights that a job or a file gives, where hand work may be already: locked groups stay to the bit, and what somebody
has changed by hand is kept for Compare Weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.rig.influences import Influences
from ..core.skinning.edits.assign import limit
from . import names
from .armature import deform_bone_names
from .attributes import read_attribute, write_attribute
from .binding import bind
from .bone_frames import armature_of
from .compared import is_edited, is_kept_edited, iter_shown, keep, kept_as_it_is, mark_edited
from .single_user import own_mesh
from .steps import Steps
from .weight_edits import iter_edit_weights, locked_groups
from .weights import check_weights, iter_write_weights

Array = NDArray[Any]

HandWork = tuple[Influences, Sequence[str]]
"""Weights, and the names of the bones that they number."""

YOURS = "your weights from before"
"""What Compare Weights calls weights that were changed by hand before others came."""


def iter_give_weights(
    splats: bpy.types.Object,
    armature: bpy.types.Object,
    weights: Array,
    bones: Sequence[str],
    *,
    only: Array | None = None,
    max_influences: int = 4,
    confidence: Array | None = None,
    start: tuple[str, Influences] | None = None,
) -> Steps[str]:
    """Give splats weights (N, B) of the B `bones`, and let them follow `armature`; words about what was not replaced,
    empty where all was.

    Locked groups, and with only (N,) bool other splats, stay to the bit. Hand work is kept beside the new weights, on
    whichever side of Compare Weights it is; of both sides that which is shown. Else `start` is, see `write_weights`. In
    slices.

    Raises InputError as `write_weights` and `iter_edit_weights` do.
    """
    check_weights(splats, armature, weights, bones)
    hand_work = yield from _iter_hand_work(splats, bones)
    if only is None and not locked_groups(splats, bones):
        options: dict[str, Any] = {"max_influences": max_influences, "confidence": confidence}
        yield from iter_write_weights(
            splats, armature, weights, bones, start=start if hand_work is None else None, **options
        )
        if hand_work is not None:
            keep(splats, YOURS, *hand_work, by_hand=True)
        return ""
    return (yield from _iter_merge(splats, armature, weights, bones, only, max_influences, confidence, hand_work))


def _iter_hand_work(splats: bpy.types.Object, bones: Sequence[str]) -> Steps[HandWork | None]:
    """What somebody has changed by hand, where it is shown of `bones`; None where nothing was."""
    if is_edited(splats):
        found = yield from iter_shown(splats, bones)
        return (found, bones) if found.value.any() else None
    # As it is: bones that were renamed since may get their names back.
    return kept_as_it_is(splats) if is_kept_edited(splats) else None


def _iter_merge(
    splats: bpy.types.Object,
    armature: bpy.types.Object,
    weights: Array,
    bones: Sequence[str],
    only: Array | None,
    max_influences: int,
    confidence: Array | None,
    hand_work: HandWork | None,
) -> Steps[str]:
    edited = is_edited(splats)
    own_mesh(splats)
    if armature_of(splats) != armature:
        bind(splats, armature)
    deform = deform_bone_names(armature)
    new = np.zeros((len(weights), len(deform)), np.float32)
    new[:, [deform.index(bone) for bone in bones]] = weights
    if max_influences:
        new = limit(new, max_influences)
    locked = locked_groups(splats, bones)
    count = yield from iter_edit_weights(splats, lambda _: new, only)
    if hand_work is not None:
        keep(splats, YOURS, *hand_work, by_hand=True)
    mark_edited(splats, edited)
    known = read_attribute(splats.data, names.CONFIDENCE)
    if confidence is not None and known is not None:
        sure = confidence if only is None else np.where(only, confidence, known)
        write_attribute(splats.data, names.CONFIDENCE, "FLOAT", sure)
    words = f"{count:,} splats of '{splats.name}' have new weights"
    return f"{words}; {len(locked)} locked groups stayed" if locked else words
