# SPDX-License-Identifier: GPL-3.0-or-later
"""What the display shows in place of the captured colours: one choice for what are several inputs of its nodes.

The nodes show bones, confidence, or any value of the splats by its name, as heat. So what moves with a splat and what
stretches are values of the splats, and need no nodes of their own; files of older versions show them, too.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.selection import alike
from . import names
from .attributes import read_attribute, write_attribute
from .bone_frames import bone_order
from .display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF
from .influences import read_influences
from .node_builder import get_input, has_input, set_input
from .node_groups import find_display
from .rotation_nodes import frames_of
from .splat_object import is_splat_object, refuse_edit_mode

CLASSES = ()
Array = NDArray[Any]

NONE, BONES, CONFIDENCE, WEIGHTS, ALIKE, STRETCH = "NONE", "BONES", "CONFIDENCE", "WEIGHTS", "ALIKE", "STRETCH"

OVERLAYS = [
    (NONE, "Captured", "The colours of the capture", 0),
    (BONES, "Bones", "Every splat in the colours of the bones that turn it", 1),
    (CONFIDENCE, "Confidence", "How sure the weights are, from blue (sure) to red (look here)", 2),
    (WEIGHTS, "Weights of a Bone", "One bone's weights, from blue (0) to red (1)", 3),
    (ALIKE, "Moves With", "How much moves as the picked splat does, from blue (not at all) to red (exactly)", 4),
    (STRETCH, "Stretch", "What Try It has stretched, from blue (not at all) to red (three times as long)", 5),
]

_VALUES = {ALIKE: names.ALIKE, STRETCH: names.STRETCH}


def overlay_of(obj: bpy.types.Object) -> str:
    """What the display of a splat object shows, one of `OVERLAYS`."""
    modifier = find_display(obj)
    if modifier is None or not has_input(modifier, SHOW_WEIGHTS_OF):
        return NONE
    if get_input(modifier, SHOW_CONFIDENCE):
        return CONFIDENCE
    shown = str(get_input(modifier, SHOW_WEIGHTS_OF))
    for overlay, name in _VALUES.items():
        if shown == name:
            return overlay
    if shown:
        return WEIGHTS
    return BONES if get_input(modifier, SHOW_BONES) else NONE


def set_overlay(obj: bpy.types.Object, overlay: str) -> None:
    """Let the display show one of `OVERLAYS`; nothing where the object has no display."""
    modifier = find_display(obj)
    if modifier is None or not has_input(modifier, SHOW_WEIGHTS_OF) or overlay_of(obj) == overlay:
        return
    active = obj.vertex_groups.active
    of = _VALUES.get(overlay, active.name if overlay == WEIGHTS and active is not None else "")
    for label, value in ((SHOW_BONES, overlay == BONES), (SHOW_CONFIDENCE, overlay == CONFIDENCE)):
        if bool(get_input(modifier, label)) != value:
            set_input(modifier, label, value)
    set_input(modifier, SHOW_WEIGHTS_OF, of)


def show_moves_with(obj: bpy.types.Object, splats: Array) -> int:
    """Colour all splats by how alike they move with the splats of an index (M,) or mask (N,), in the mean of these; the
    number of those that share at least half of their weights.

    The colours follow the weights from now on (`follow_weights`). Raises InputError in Edit Mode, and where no armature
    moves the splats, or none of those meant.
    """
    refuse_edit_mode(obj)
    meant = np.zeros(len(obj.data.vertices), np.bool_)
    meant[splats] = True
    shared = _alike(obj, meant)
    if shared is None:
        raise InputError(f"No splats of '{obj.name}' are meant; click one, or select some.")
    write_attribute(obj.data, names.ALIKE, "FLOAT", shared)
    write_attribute(obj.data, names.MEANT, "BOOLEAN", meant)
    obj.data.update()
    set_overlay(obj, ALIKE)
    return int((shared >= 0.5).sum())


def _alike(obj: bpy.types.Object, meant: Array) -> Array | None:
    """(N,) how alike all splats move with those of a mask (N,); None where no bone moves these. InputError as above."""
    frames, stored = frames_of(obj), read_influences(obj)
    if frames is None or stored is None:
        raise InputError(f"'{obj.name}' follows no armature by weights of its own; bind it to one first.")
    index, value = stored
    count = len(bone_order(frames))
    # A splat that no bone moves has one of its own, the last.
    index = np.where((value > 0) & (index >= 0), index, count)
    reference = np.bincount(index[meant].ravel(), value[meant].ravel(), count + 1)
    if not reference.sum() > 0:
        return None
    return np.asarray(alike(index, value, (reference / reference.sum()).astype(np.float32)))


def follow_weights(obj: bpy.types.Object) -> None:
    """What is shown of weights is that of the present ones, or is known to be of earlier ones (`is_of_before`)."""
    meant = read_attribute(obj.data, names.MEANT)
    if meant is not None and meant.any():
        shared = _alike(obj, meant)
        if shared is not None:
            write_attribute(obj.data, names.ALIKE, "FLOAT", shared)
            obj.data.update()
    if names.STRETCH in obj.data.attributes:
        obj.data[names.MARK]["stretch_of_before"] = True


def is_of_before(obj: bpy.types.Object) -> bool:
    """Whether what the display shows was measured with other weights than the splats have."""
    return overlay_of(obj) == STRETCH and bool(obj.data[names.MARK].get("stretch_of_before", False))


def follow_active_group(obj: bpy.types.Object) -> None:
    """In Weight Paint the weights that are shown are those that are painted."""
    active = obj.vertex_groups.active
    if obj.mode == "WEIGHT_PAINT" and active is not None and overlay_of(obj) == WEIGHTS:
        modifier = find_display(obj)
        if get_input(modifier, SHOW_WEIGHTS_OF) != active.name:
            set_input(modifier, SHOW_WEIGHTS_OF, active.name)


def show_stretch(obj: bpy.types.Object, stretch: Array) -> None:
    """Colour all splats by how many times as long (N,) their surroundings became: 1 is blue, 3 and more red."""
    write_attribute(obj.data, names.STRETCH, "FLOAT", np.clip((np.asarray(stretch) - 1) / 2, 0, 1))
    if "stretch_of_before" in obj.data[names.MARK]:
        del obj.data[names.MARK]["stretch_of_before"]
    obj.data.update()
    set_overlay(obj, STRETCH)


def _get(obj: Any) -> int:
    overlay = overlay_of(obj) if is_splat_object(obj) else NONE
    return next(number for name, _, _, number in OVERLAYS if name == overlay)


def _set(obj: Any, number: int) -> None:
    if is_splat_object(obj):
        set_overlay(obj, OVERLAYS[number][0])


def register() -> None:
    objects: Any = bpy.types.Object
    objects.gskin_overlay = bpy.props.EnumProperty(
        name="Show",
        description="What colours the splats have in the 3D view and in renders",
        items=OVERLAYS,
        get=_get,
        set=_set,
    )


def unregister() -> None:
    objects: Any = bpy.types.Object
    del objects.gskin_overlay
