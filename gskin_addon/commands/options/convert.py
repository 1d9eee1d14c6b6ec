# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core.splats.axes import UP_AXES
from .shared import common


def add(commands: Any) -> None:
    """Add `gskin convert` to the commands."""
    convert = commands.add_parser(
        "convert",
        help="turn a file of splats into another format",
        description="Turn a file of splats into the format that the output's name asks for (docs/formats.md).",
        allow_abbrev=False,
    )
    convert.add_argument("source", type=Path, metavar="IN", help="splats: .ply, .spz, .sog, .glb, .splat, .ksplat")
    convert.add_argument("out", type=Path, metavar="OUT", help="what to write; .compressed.ply for the compressed one")
    convert.add_argument("--up", choices=UP_AXES, help="IN's up axis (default: by its format's rules, else -y)")
    convert.add_argument("--out-up", choices=UP_AXES, help="OUT's up axis (default: by its format's rules, else -y)")
    convert.add_argument("--drop-invalid", action="store_true", help="leave out splats with NaN or infinite values")
    common(convert)
