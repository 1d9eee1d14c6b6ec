# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons as text: RigNet's format, which Puppeteer, MagicArticulate and SkinTokens write too.

    joints NAME X Y Z
    root NAME
    hier PARENT CHILD
    skin VERTEX NAME WEIGHT NAME WEIGHT ...     (for a mesh; not read here)

The axes are those of the mesh that the program was given, mostly y up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..rig.joint_lines import JointLines, numbered_lines
from ..rig.skeleton import Skeleton
from .joint_tree import skeleton_of_joints


def read_joint_text(path: Path) -> Skeleton:
    """The skeleton in a text of joints, with the file's axes and unit; lines of other kinds are passed over.

    Raises:
        InputError: not readable, no such text, or no tree.
    """
    lines = JointLines()
    for number, words in numbered_lines(path, errors="replace"):
        try:
            lines.take(words)
        except ValueError:
            line = " ".join(words)[:60]
            raise InputError(f"Line {number} of '{path}' is damaged ('{line}'); write the file again.") from None
    if not lines.joints:
        raise InputError(f"'{path}' has no 'joints' lines; give a skeleton as RigNet or Puppeteer write it.")
    unknown = lines.unknown()
    if unknown is not None:
        raise InputError(f"'{path}' joins '{unknown}', which has no 'joints' line; write the file again.")
    places = np.array(list(lines.joints.values()))
    return skeleton_of_joints(list(lines.joints), lines.parent_numbers(), places, label=f"'{path}'")
