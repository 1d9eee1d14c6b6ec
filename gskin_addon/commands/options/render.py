# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin render`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core.splats.axes import UP_AXES
from .numbers import positive, unit
from .shared import common, front, posing, progress, up

VIEWS = ("front", "back", "front-left", "front-right", "left", "right")


def add(commands: Any) -> None:
    """Add `gskin render` to the commands."""
    render = commands.add_parser(
        "render",
        help="draw splats to a picture",
        description="Draw splats (.ply, .spz, .sog, ...) or rigged splats (.blend) in a pose to a PNG; with --view "
        "camera all splats of a .blend from its scene's camera, with alpha, in the scene's resolution, behind its "
        "other objects.",
        allow_abbrev=False,
    )
    render.add_argument("source", type=Path, metavar="SPLATS", help="splats, or .blend that `gskin rig` wrote")
    render.add_argument("--out", type=Path, required=True, metavar="IMAGE.png")
    render.add_argument("--view", choices=(*VIEWS, "camera"), default="front-left", help="(default: %(default)s)")
    render.add_argument("--frames", metavar="A-B", help="with --view camera: these frames, as 1-24 or 1-24x2")
    render.add_argument("--resume", action="store_true", help="with --view camera: leave frames that are there")
    render.add_argument(
        "--depth", action="store_true", help="with --view camera: also depth, as Z of an .exr or beside a .png"
    )
    render.add_argument("--size", type=positive, default=512, metavar="PIXELS", help="(default: %(default)s)")
    render.add_argument(
        "--background", type=unit, nargs=3, default=[1.0, 1.0, 1.0], metavar=("R", "G", "B"), help="0 to 1"
    )
    render.add_argument(
        "--color",
        choices=("splats", "weights", "confidence"),
        default="splats",
        help="the splats' own colours, one per bone, or how sure the weights are, red to blue",
    )
    render.add_argument(
        "--engine",
        choices=("gskin", "cycles"),
        default="gskin",
        help="our rasteriser, or Blender's Cycles (.blend)",
    )
    up(render, UP_AXES, "the splat file's up axis (default: by the format's rules, else z)")
    render.add_argument("--python", metavar="PYTHON", default="", help="the Python that draws for --view camera")
    progress(render)
    front(render)
    posing(render)
    common(render)
