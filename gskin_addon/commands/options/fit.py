# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin fit`, and those of a fit that `gskin rig` has too."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.job.up_axis import UP_CHOICES
from ...core.skeleton.fit import KINDS, LOOKS
from .shared import common, up


def add(commands: Any) -> None:
    """Add `gskin fit` to the commands."""
    fit = commands.add_parser(
        "fit",
        help="fit a skeleton to splats, or bring one of another program into them",
        description="Fit the skeleton of a person or an animal to splats, or bring the joints of another program into "
        "them, and save it: with the splats as .blend, or the bones alone as .json.",
        allow_abbrev=False,
    )
    fit.add_argument("splats", type=Path, metavar="SPLATS", help="Gaussian splats (.ply, .spz, .sog, ...)")
    fit.add_argument("--kind", choices=tuple(KINDS), help="what body it is")
    fit.add_argument(
        "--skeleton", type=Path, metavar="FILE", help="joints as .txt or .npz, .bvh, .fbx, .vrm, .glb or .blend"
    )
    fit.add_argument("--out", type=Path, required=True, metavar="OUT", help="what to write: .blend or .json")
    up(fit, UP_CHOICES, "the splat file's up axis (default: guessed)")
    fit.add_argument("--drop-invalid", action="store_true", help="leave out splats with NaN or infinite values")
    fitting(fit)
    common(fit)


def fitting(parser: argparse.ArgumentParser) -> None:
    """How a skeleton is fitted."""
    parser.add_argument(
        "--looks-to", choices=("auto", *LOOKS), default="auto", help="of a fit: to where the body looks, z up"
    )
    parser.add_argument(
        "--sides",
        choices=("auto", "alike", "apart"),
        default="auto",
        help="of a fit: both sides as mirror images, or each as it is (default: where they nearly are)",
    )
    parser.add_argument(
        "--landmark",
        action="append",
        nargs=4,
        default=[],
        metavar=("NAME", "X", "Y", "Z"),
        help="of a fit: where hand.L, foot.R, head and so on end, z up; repeatable",
    )
    parser.add_argument(
        "--no-rigify",
        dest="rigify",
        action="store_false",
        help="of a fit: plain bones, without Rigify's settings",
    )
