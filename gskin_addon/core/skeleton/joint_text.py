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
from ..rig.skeleton import Skeleton
from .joint_tree import skeleton_of_joints

_LARGEST = 200_000_000
"""Bytes; a text with the weights of a million vertices has half of it."""


def read_joint_text(path: Path) -> Skeleton:
    """The skeleton in a text of joints, with the file's axes and unit.

    Raises:
        InputError: not readable, no such text, or no tree.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise InputError(f"'{path}' is too large for a text of joints; give the skeleton that the program wrote.")
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror or error}); check the path.") from error
    places: dict[str, tuple[float, ...]] = {}
    parent_of: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0] not in ("joints", "hier"):
            continue
        try:
            if words[0] == "joints":
                places[words[1]] = tuple(float(word) for word in words[2:5])
                if len(places[words[1]]) != 3:
                    raise ValueError
            else:
                parent_of[words[2]] = words[1]
        except (ValueError, IndexError):
            raise InputError(f"Line {number} of '{path}' is damaged ('{line[:60]}'); write the file again.") from None
    if not places:
        raise InputError(f"'{path}' has no 'joints' lines; give a skeleton as RigNet or Puppeteer write it.")
    unknown = sorted({*parent_of, *parent_of.values()} - set(places))
    if unknown:
        raise InputError(f"'{path}' joins '{unknown[0]}', which has no 'joints' line; write the file again.")
    names = list(places)
    number_of = {name: number for number, name in enumerate(names)}
    parents = [number_of[parent_of[name]] if name in parent_of else -1 for name in names]
    return skeleton_of_joints(names, parents, np.array(list(places.values())), label=f"'{path}'")
