# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's frame as one number: Blender keeps a whole one, towards zero, and a part of the same sign."""

from __future__ import annotations

import bpy


def frame_of(scene: bpy.types.Scene) -> float:
    """The present frame, with its part."""
    return scene.frame_current + scene.frame_subframe


def go_to(scene: bpy.types.Scene, frame: float) -> None:
    """Go to a frame, which may lie between two whole ones, and evaluate it."""
    whole, part = divmod(frame, 1.0)
    scene.frame_set(int(whole), subframe=part)
