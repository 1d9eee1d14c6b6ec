# SPDX-License-Identifier: GPL-3.0-or-later
"""The skeleton of a Biovision motion file (.bvh): its hierarchy at rest; the motion stays behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..rig.skeleton import Skeleton
from .joint_tree import bone_ends, skeleton_of_joints

_LARGEST = 2_000_000_000


def read_bvh(path: Path) -> Skeleton:
    """The skeleton of a .bvh, with the file's axes and unit.

    Raises:
        InputError: not readable, or no such hierarchy.
    """
    words = _hierarchy(path)
    names: list[str] = []
    parents: list[int] = []
    places: list[list[float]] = []
    ends: dict[int, list[float]] = {}
    stack: list[int] = []
    in_end = False
    at = 0

    def following(count: int) -> list[str]:
        nonlocal at
        taken = words[at : at + count]
        at += count
        if len(taken) < count:
            raise ValueError("it ends too soon")
        return taken

    try:
        while at < len(words):
            (word,) = following(1)
            match word.upper():
                case "HIERARCHY" | "{":
                    pass
                case "ROOT" | "JOINT":
                    names.append(following(1)[0])
                    parents.append(stack[-1] if stack else -1)
                    places.append([0.0, 0.0, 0.0] if not stack else list(places[stack[-1]]))
                    stack.append(len(names) - 1)
                case "END":
                    following(1)
                    in_end = True
                case "OFFSET":
                    offset = [float(number) for number in following(3)]
                    base = places[stack[-1]]
                    moved = [a + b for a, b in zip(base, offset, strict=True)]
                    if in_end:
                        ends[stack[-1]] = moved
                    else:
                        places[stack[-1]] = moved
                case "CHANNELS":
                    following(int(following(1)[0]))
                case "}":
                    if in_end:
                        in_end = False
                    else:
                        stack.pop()
                case _:
                    raise ValueError(f"'{word[:30]}' is unknown")
    except (ValueError, IndexError) as error:
        raise InputError(f"'{path}' is no .bvh skeleton ({error}); export it again.") from None
    label = f"'{path}'"
    plain = skeleton_of_joints(names, parents, np.array(places).reshape(-1, 3), label=label)
    tails = bone_ends(plain.heads, plain.parents)  # a .bvh lists parents first, so the order is the file's
    for bone, end in ends.items():
        tails[bone] = end
    return skeleton_of_joints(names, parents, np.array(places), tails, label=label)


def _hierarchy(path: Path) -> list[str]:
    """The words before the motion."""
    words: list[str] = []
    try:
        if path.stat().st_size > _LARGEST:
            raise InputError(f"'{path}' is too large for a .bvh; cut its motion.")
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.strip().upper() == "MOTION":
                    break
                words.extend(line.split())
                if len(words) > 1_000_000:
                    raise InputError(f"'{path}' is no .bvh: no MOTION follows its hierarchy; export it again.")
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror or error}); check the path.") from error
    if not words or words[0].upper() != "HIERARCHY":
        raise InputError(f"'{path}' is no .bvh: it does not begin with HIERARCHY; export it again.")
    return words
