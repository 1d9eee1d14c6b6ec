# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin pose`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core.splats.axes import UP_AXES
from .shared import common, posing, up


def add(commands: Any) -> None:
    """Add `gskin pose` to the commands."""
    pose = commands.add_parser(
        "pose",
        help="pose rigged splats and save them",
        description="Pose rigged splats by a frame of an action or by turning bones, and save the result.",
        allow_abbrev=False,
    )
    pose.add_argument("source", type=Path, metavar="RIGGED.blend", help="what `gskin rig` wrote")
    pose.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="OUT",
        help="what to write: .blend, .glb with the rig, or posed splats (.ply, .spz, .sog, ...)",
    )
    up(pose, UP_AXES, "the up axis of posed splats (default: by their format's rules, else as the splats came in)")
    posing(pose)
    common(pose)
