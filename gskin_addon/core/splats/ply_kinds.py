# SPDX-License-Identifier: GPL-3.0-or-later
"""Kinds of splat .ply files besides the plain 3DGS one, by their properties: what is made of them, in words."""

from __future__ import annotations

from .ply_codec import FILTER, SCALES, THIN
from .ply_header import Element

_OF_TIME = ("t", "scale_t", "trbf_center", "trbf_scale", "t_scale", "duration")
"""When a splat is there: 4D Gaussian Splatting (Yang et al. 2024), Spacetime Gaussians (Li et al. 2024), FreeTimeGS."""
_OF_MOTION = ("motion_", "omega_", "rot_r_", "velocity", "vel_")
"""How it moves meanwhile; names begin so."""


def notes_of(vertex: Element) -> tuple[str, ...]:
    """Clauses about what the vertex properties of a file are and how they are read; none for plain 3DGS."""
    notes, properties = [], vertex.properties
    scales = [name for name in SCALES if name in properties]
    if len(scales) == 2:
        notes.append(f"flat discs (two scales, as 2DGS): the third scale is {THIN:g} of the smaller one")
    elif len(scales) == 1:
        notes.append("one scale: the splats are balls")
    if FILTER in properties:
        notes.append(f"the {FILTER} of Mip-Splatting is fused into scales and opacity")
    times = [name for name in _OF_TIME if name in properties]
    times += [name for name in properties if name.startswith(_OF_MOTION)]
    if times:
        some = ", ".join(times[:4]) + (", ..." if len(times) > 4 else "")
        notes.append(
            f"its splats change with time ({some}): those of all times are read as they stand, "
            "and these columns are kept as they are, but not played"
        )
    if vertex.lists:
        some = ", ".join([*vertex.lists][:4]) + (", ..." if len(vertex.lists) > 4 else "")
        notes.append(f"the lists of its splats ({some}) are left out")
    return tuple(notes)
