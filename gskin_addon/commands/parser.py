# SPDX-License-Identifier: GPL-3.0-or-later
"""The parser of the command line, made of the options of every command."""

from __future__ import annotations

import argparse

from .options import convert, fit, pose, render, rig, runtime, train_guidance, train_prior, weights
from .options.shared import Parser

VERSION = "0.2.0"


def build() -> argparse.ArgumentParser:
    """The parser of all commands; `options.command` names the module that runs."""
    parser = Parser(
        prog="gskin",
        description="Auto-skin Gaussian splats: weights, posing and rigged glTF.",
        epilog="Exit codes: 0 done, 2 bad input, 1 failure, 130 cancelled.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"gskin {VERSION}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    rig.add(commands)
    fit.add(commands)
    pose.add(commands)
    render.add(commands)
    convert.add(commands)
    weights.add(commands)
    train_guidance.add(commands)
    train_prior.add(commands)
    runtime.add(commands)
    return parser
