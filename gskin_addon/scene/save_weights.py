# SPDX-License-Identifier: GPL-3.0-or-later
"""The vertex groups of splats as a weights file: ours, or for a name in .txt RigNet's."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..core.errors import InputError
from ..core.rig.rignet_file import write_rignet
from ..core.rig.weights_file import write_weights_file
from . import names
from .armature import read_skeleton
from .attributes import read_attribute
from .proxy_object import followed_armature
from .weights import read_weights


def save_weights(splats: bpy.types.Object, path: Path) -> tuple[int, int]:
    """Write the normalised weights of splats that follow an armature; the numbers of splats and deform bones.

    Raises InputError: splats without weights, no deform bones, Edit Mode. GSkinError: the file cannot be written.
    """
    armature = followed_armature(splats)
    skeleton = read_skeleton(armature)
    weights, _ = read_weights(splats, skeleton.names)
    total = weights.sum(axis=1, keepdims=True)
    empty = int((total <= 0).sum())
    if empty:
        raise InputError(
            f"{empty:,} of the {len(weights):,} splats of '{splats.name}' have no weights for bones of "
            f"'{armature.name}'; paint some, or run Auto-Skin."
        )
    if path.suffix.lower() == ".txt":
        write_rignet(path, weights / total, skeleton)
        return len(weights), skeleton.count
    confidence = read_attribute(splats.data, names.CONFIDENCE)
    write_weights_file(path, weights / total, skeleton, confidence=confidence)
    return len(weights), skeleton.count
