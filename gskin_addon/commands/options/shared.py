# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that several commands have."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NoReturn

from ...core.job.settings import FRONTS
from .numbers import frame


class Parser(argparse.ArgumentParser):
    """Mistakes in the options are one sentence too."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help.\n")


def consent(parser: argparse.ArgumentParser) -> None:
    """The agreement to download a model."""
    parser.add_argument(
        "--allow-download", action="store_true", help="fetch a model named by its hub id, where it is not here yet"
    )


def progress(parser: argparse.ArgumentParser) -> None:
    """How progress is told."""
    parser.add_argument(
        "--progress",
        choices=("auto", "bar", "lines", "json", "none"),
        default="auto",
        help="on stderr: a bar on terminals, else lines (auto); or the worker's JSON lines",
    )


def up(parser: argparse.ArgumentParser, choices: Sequence[str], tip: str) -> None:
    """The up axis of a file of splats."""
    parser.add_argument("--up", "--ply-up", dest="up", choices=tuple(choices), help=tip)


def front(parser: argparse.ArgumentParser) -> None:
    """The side that the object faces."""
    parser.add_argument(
        "--front",
        choices=tuple(FRONTS),
        default="-y",
        help="the side that the object faces (default: %(default)s); write --front=-x",
    )


def posing(parser: argparse.ArgumentParser) -> None:
    """The pose of a rigged object."""
    parser.add_argument("--object", metavar="NAME", help="which splat object, where the file has several")
    parser.add_argument("--action", metavar="NAME", help="the action of the armature to take the pose from")
    parser.add_argument("--slot", metavar="NAME", help="which slot of that action, where several fit the armature")
    parser.add_argument("--frame", type=frame, metavar="F", help="the frame to take the pose from")
    parser.add_argument(
        "--rotate",
        action="append",
        nargs=4,
        default=[],
        metavar=("BONE", "X", "Y", "Z"),
        help="turn a bone by a rotation vector in degrees, along the world's axes at rest; repeatable",
    )
    parser.add_argument(
        "--set",
        action="append",
        nargs=3,
        default=[],
        metavar=("BONE", "PROPERTY", "VALUE"),
        help="set a custom property of a bone, such as a switch between FK and IK; repeatable",
    )


def common(parser: argparse.ArgumentParser) -> None:
    """What every command has."""
    parser.add_argument("--verbose", action="store_true", help="show what Blender prints, and where an error happened")
