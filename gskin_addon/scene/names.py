# SPDX-License-Identifier: GPL-3.0-or-later
"""Names under which gskin keeps things in a .blend file. Changing one breaks saved files."""

from __future__ import annotations

MARK = "gskin"
"""Custom property that marks a splat mesh: a group with version, sh_degree, the names and number types of extra
columns, and where known the file's up axis (up) and what an applied transform has broken (warning)."""

OFFSET = "gskin_offset"
"""Custom property of a splat object: how far it was moved from the file's coordinates."""

GEO_OFFSET = "gskin_geo_offset"
"""Custom property of a splat object whose file lies far from the origin: world coordinates + it are the file's, turned
to Blender's axes. Not there for others."""

STANDS_FOR = "gskin_stands_for"
"""Custom property of a copy of a splat object that is read while it is edited: the session id of what is edited."""

PLACES = "gskin_places"
"""Custom property of a splat mesh: where some splats were when all attributes fitted together."""

FRAMES_MARK = "gskin_bone_frames"
"""Custom property that marks the hidden helper mesh of bone frames."""

FRAMES_LAYOUT = "gskin_layout"
"""Custom property of the bone frames: what their points were made for."""

PROBE_MARK = "gskin_probe"
"""Custom property that marks the hidden probes of a splat object, and their mesh."""

OCTAHEDRA_MARK = "gskin_octahedra"
"""Custom property that marks the hidden helper whose faces the display borrows."""
OCTAHEDRON_MARK = "gskin_octahedron"
"""Custom property of the mesh of the one octahedron."""

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

TURN = "gskin:turn"
"""How the bones turn each splat (quaternion wxyz, object space); exists only on the evaluated mesh."""

REST = "gskin:rest"
"""Where each splat is at rest (object space); exists where bendy bones move it."""

# On the points of the bone frames, by frame: its axes and origin at rest, the length of its axes, of bendy bones the
# first joint, the number of segments and their length, and whether the frame is such a joint.
FRAME_AXES = "gskin:axes"
FRAME_ORIGIN = "gskin:origin"
FRAME_SIZE = "gskin:size"
FRAME_BEND = "gskin:bend"
FRAME_JOINT = "gskin:joint"

# While the rotation nodes run: on the frames, the bone's map, how it stretches, and the way into the frame at rest; on
# the splats, new axes (columns) and turn of those that are stretched.
FRAME_MAP = "gskin:map"
FRAME_STRETCH = "gskin:stretch"
FRAME_INVERSE = "gskin:inverse"
FRAME_LOCAL = "gskin:local"
FRAME_ODD = "gskin:odd"
SHAPE = "gskin:shape"

CONFIDENCE = "gskin:confidence"
"""How sure the weights of each splat are, 0 to 1; exists where the method that made them knows."""

ALIKE = "gskin:alike"
"""How much each splat moves with the one that was picked last, 0 to 1; exists where one was."""
MEANT = "gskin:meant"
"""Which splats those of `ALIKE` were compared with."""
STRETCH = "gskin:stretch"
"""How far Try It has stretched what is around each splat: 0 not at all, 1 to three times its length and more."""

SIDE = "gskin:side"
"""Label of a splat at a seam, 0 for none: splats with two labels belong to parts that touch but are not one."""

COMPARED = "gskin_compared"
"""Custom property of a splat mesh whose weights have a counterpart to compare with: a group with name (of what was
before), shown ("before" or "result") and bones, those of the kept side."""
KEPT_BONE = "gskin:kept_bone_{}"
"""On the points: the side that is not shown. Index into these bones; what has weight 0 is empty."""
KEPT_WEIGHT = "gskin:kept_weight_{}"

COLOR = "gskin:color"
"""Linear colour and opacity of a drawn splat; exists only on the display geometry."""

ARMATURE_MODIFIER = "Armature"
ROTATION_MODIFIER = "GSkin Rotation"
DISPLAY_MODIFIER = "GSkin Display"
ANCHOR_MODIFIER = "GSkin Anchor"

TEST_POSE = "gskin_test_pose"
"""Custom property of an armature and of the pose assets that were made for it: the same word on all of them."""

ANCHOR_MARK = "gskin_anchor_mesh"
"""Custom property that marks the hidden helper mesh of anchored splats."""

EDGES_ONLY = "gskin_edges_only"
"""Custom property of that mesh: its one-ring maps come from the edges alone."""

# Where a splat hangs on its proxy mesh (Eq. 4): triangle, barycentrics, offset, what Eq. 4 leaves out, and the bound
# of the posed circumradius.
FACE = "gskin:face"
BARY = "gskin:bary"
BETA = "gskin:beta"
RESIDUAL = "gskin:residual"
REACH = "gskin:reach"

# On the corners of the helper mesh: neighbours in the triangle and coefficients of the one-ring maps.
CORNER_NEXT = "gskin:next"
CORNER_LAST = "gskin:last"
MAP_COEFFICIENTS = ("gskin:g_next", "gskin:g_last", "gskin:g_normal")
RING_SHARE = "gskin:ring_share"
# On its points, while the nodes run: columns of the vertices' rotation and shear.
MAP_ROTATION = tuple(f"gskin:r_{k}" for k in range(3))
MAP_SHEAR = tuple(f"gskin:s_{k}" for k in range(3))
