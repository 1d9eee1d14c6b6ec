# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin weights`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.skinning.transfer.match import ANGLE, REACH
from ...core.splats.axes import UP_AXES
from .numbers import length, positive, unit
from .shared import common


def add(commands: Any) -> None:
    """Add `gskin weights` to the commands."""
    weights = commands.add_parser(
        "weights",
        help="change the weights of rigged splats",
        description="Change the weights of rigged splats, in the order in which the changes are given. Every changed "
        "splat keeps its four strongest bones; weights sum to 1.",
        allow_abbrev=False,
    )
    weights.set_defaults(changes=[])
    weights.add_argument("source", type=Path, metavar="RIGGED.blend", help="what `gskin rig` wrote")
    weights.add_argument("--out", type=Path, metavar="OUT", help="what to write: .blend or .glb")
    weights.add_argument(
        "--weights", type=Path, metavar="W.npz", help="write the weights as arrays, or as RigNet's text (.txt)"
    )
    weights.add_argument("--object", metavar="NAME", help="which splats, where the file has several")
    weights.add_argument("--smooth", type=positive, metavar="N", action=_Change, help="N steps towards the neighbours")
    weights.add_argument(
        "--sharpen", type=unit, metavar="AMOUNT", action=_Change, help="0 nothing, 1 only the strongest bone"
    )
    weights.add_argument(
        "--mirror", choices=("left", "right"), action=_Change, help="the side whose weights the other one gets"
    )
    weights.add_argument("--limit", type=positive, metavar="N", action=_Change, help="at most N bones a splat")
    weights.add_argument("--normalise", nargs=0, action=_Change, help="make the weights of each splat sum to 1")
    weights.add_argument("--to-bone", metavar="BONE", action=_Change, help="selected splats follow this bone alone")
    weights.add_argument(
        "--flood", nargs=2, metavar=("BONE", "WEIGHT"), action=_Change, help="one weight for the selected splats"
    )
    weights.add_argument(
        "--follow-neighbours", nargs=0, action=_Change, help="selected splats take weights from those around them"
    )
    weights.add_argument(
        "--from-mesh",
        type=Path,
        metavar="MESH",
        action=_Change,
        help="weights of a skinned mesh in the same place: .glb, .npz, or RigNet's .txt with an .obj beside it",
    )
    weights.add_argument(
        "--from-splats",
        type=Path,
        metavar="RIGGED",
        action=_Change,
        help="weights of other rigged splats in the same place: .blend or .glb",
    )
    weights.add_argument(
        "--to-mesh",
        nargs=2,
        type=Path,
        metavar=("MESH", "W"),
        help="write weights for a mesh in the same place (.obj, .npz, .glb): as .npz, .glb or RigNet's .txt",
    )
    weights.add_argument("--mesh-up", choices=UP_AXES, help="up axis of meshes (default: y for .obj and .glb, else z)")
    weights.add_argument(
        "--reach",
        type=unit,
        default=REACH,
        metavar="SHARE",
        help="how far weights go, as a share of the source's size (default: %(default)s)",
    )
    weights.add_argument(
        "--angle", type=length, default=ANGLE, metavar="DEGREES", help="that both surfaces may face apart (default: 45)"
    )
    weights.add_argument(
        "--no-inpaint", dest="inpaint", action="store_false", help="what has no match takes what is nearest"
    )
    weights.add_argument(
        "--fit", action="store_true", help="first bring the same surface that is a little off onto the other one"
    )
    weights.add_argument(
        "--select", type=Path, metavar="FILE", help="splats to change: .npz with `selected`, or a text of their numbers"
    )
    weights.add_argument(
        "--select-bone", action="append", default=[], metavar="BONE", help="splats that follow it most; repeatable"
    )
    weights.add_argument(
        "--rim", type=length, default=0.0, metavar="METRES", help="way over which --to-bone fades out (default: 0)"
    )
    weights.add_argument(
        "--lock", action="append", default=[], metavar="BONE", help="a bone whose weights stay; repeatable"
    )
    common(weights)


class _Change(argparse.Action):
    """Collects changes in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        if self.dest == "flood":
            try:
                values = (values[0], unit(values[1]))
            except (ValueError, argparse.ArgumentTypeError):
                parser.error(f"argument --flood: the weight '{values[1]}' is not a number in 0..1")
        namespace.changes = [*namespace.changes, (self.dest, values)]
