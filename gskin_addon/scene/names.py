# SPDX-License-Identifier: GPL-3.0-or-later
"""Names under which gskin keeps things in a .blend file. Changing one breaks saved files."""

from __future__ import annotations

MARK = "gskin"
"""Custom property that marks a splat mesh: a group with version, sh_degree and the names of extra columns."""

FRAMES_MARK = "gskin_bone_frames"
"""Custom property that marks the hidden helper mesh of bone frames."""

# Names that Blender 5.3 and later use for splats on point clouds.
ROTATION = "rotation"
SCALE = "scale"
BASE = "radiance:base"
SH = "radiance:sh_{}"

EXTRA = "ply:{}"
"""Further PLY properties, so that none can collide with an attribute of Blender's."""

INFLUENCES = 4
"""Bones that turn one splat."""
BONE = "gskin:bone_{}"
"""Index of the i-th strongest bone among the bone frames; -1 for none."""
WEIGHT = "gskin:weight_{}"

COLOR = "gskin:color"
"""Linear colour and opacity of a drawn splat; exists only on the display geometry."""

ARMATURE_MODIFIER = "Armature"
ROTATION_MODIFIER = "GSkin Rotation"
DISPLAY_MODIFIER = "GSkin Display"
