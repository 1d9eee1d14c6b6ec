# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons from files that need no Blender: texts and arrays of rigging programs, and motion files."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from ..rig.skeleton import Skeleton
from .bvh import read_bvh
from .joint_arrays import read_joint_arrays
from .joint_text import read_joint_text

READERS = {".txt": read_joint_text, ".npz": read_joint_arrays, ".bvh": read_bvh}
"""The reader of each ending."""

_MOST = 20_000


def read_skeleton_file(path: Path) -> Skeleton:
    """The skeleton of a file with an ending of `READERS`, with the file's axes and unit.

    Raises:
        InputError: another ending, not readable, or no skeleton.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"'{path}' is no skeleton file; give a {', '.join(READERS)} file.")
    skeleton = reader(path)
    if skeleton.count > _MOST:
        raise InputError(f"'{path}' has {skeleton.count:,} joints; give a skeleton with at most {_MOST:,}.")
    return skeleton
