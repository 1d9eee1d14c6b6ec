# SPDX-License-Identifier: GPL-3.0-or-later
"""Landmarks: where somebody says that a hand, a foot or the head is, and the fit that is brought there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[Any]

CHAINS = {
    "hand": ("shoulder", "elbow", "wrist"),
    "foot": ("thigh", "knee", "ankle", "toe"),
    "front_paw": ("front_thigh", "front_shin", "front_foot", "front_toe"),
    "hind_paw": ("thigh", "shin", "foot", "toe"),
    "wing": ("wing", "wing_elbow", "wing_wrist", "wing_tip"),
    "beak": ("neck", "head", "beak"),
    "head": ("neck", "head"),
}
"""Landmarks and the joints that go along, from the one that stays to the outermost."""

ENDS = {"hand": "fingers", "foot": "toe_tip", "front_paw": "front_toe_tip", "hind_paw": "toe_tip", "wing": "wing_tip",
        "beak": "beak", "head": "crown"}  # fmt: skip
"""Landmarks and the point of a layout in which the last bone of the limb ends."""

NAMES = ("head", "beak", *(f"{name}.{side}" for name in CHAINS if name not in ("head", "beak") for side in "LR"))


def move_to_landmarks(
    joints: Mapping[str, Array], landmarks: Mapping[str, Array], surface: Array
) -> dict[str, Array]:
    """The joints with the limbs turned and stretched about their first joint so that their ends reach the landmarks.

    A landmark is a name of `NAMES`, or of another of the joints, which is then put there. surface (M, 3): of the body;
    all in one frame.

    Raises:
        InputError: a landmark that the body has not.
    """
    out = {name: np.asarray(place, np.float64) for name, place in joints.items()}
    for name, place in landmarks.items():
        goal = np.asarray(place, np.float64)
        if name in out and name not in NAMES:
            out[name] = goal
            continue
        chain = _chain(name, out)
        if not chain:
            raise InputError(f"'{name}' is no landmark of this body; choose one of {', '.join(possible(joints))}.")
        start = out[chain[0]]
        end = _end(out[chain[-2]], out[chain[-1]], surface)
        turn = _stretch(end - start, goal - start)
        for joint in chain[1:]:
            out[joint] = start + turn @ (out[joint] - start)
    return out


def ends_at(points: Mapping[str, Array], landmarks: Mapping[str, Array]) -> dict[str, Array]:
    """The points of a layout, with those that are landmarks where somebody has said that they are."""
    out = dict(points)
    for name, place in landmarks.items():
        kind, dot, side = name.partition(".")
        end = f"{ENDS.get(kind, '')}{dot}{side}"
        if name in NAMES and end in out:
            out[end] = np.asarray(place, np.float64)
    return out


def on_their_sides(landmarks: Mapping[str, Array]) -> float:
    """How far landmarks (3,) of a body that looks along -y lie on the sides that their names say, metres, summed; less
    than 0 where the body looks the other way. The left side is +x; those of no side say nothing."""
    signs = {".L": 1.0, ".R": -1.0}
    return float(sum(signs.get(name[-2:], 0.0) * place[0] for name, place in landmarks.items()))


def possible(joints: Mapping[str, Array]) -> list[str]:
    """The landmarks that a body with these joints has."""
    return [name for name in NAMES if _chain(name, joints)]


def _chain(name: str, joints: Mapping[str, Array]) -> list[str]:
    """The joints that go along with a landmark; none where the body has not all of them, one in between excepted."""
    kind, _, side = name.partition(".")
    wanted = [f"{joint}.{side}" if side else joint for joint in CHAINS.get(kind, ())] if name in NAMES else []
    found = [joint for joint in wanted if joint in joints]
    enough = len(found) >= max(2, len(wanted) - 1) and wanted[0] in joints and wanted[-1] in joints
    return found if enough else []


def _end(before: Array, last: Array, surface: Array) -> Array:
    """The outermost surface of a limb whose last two joints are given."""
    way = last - before
    length = max(float(np.linalg.norm(way)), 1e-12)
    off = surface - last
    along = off @ way / length
    near = (along > 0) & (np.linalg.norm(off, axis=1) < length)
    return np.asarray(surface[near][along[near].argmax()] if near.any() else last + 0.3 * way)


def _stretch(start: Array, goal: Array) -> Array:
    """The (3, 3) turn and even stretch, without twist, from one way to another."""
    a, b = float(np.linalg.norm(start)), float(np.linalg.norm(goal))
    if a < 1e-12 or b < 1e-12:
        return np.eye(3)
    u, v = start / a, goal / b
    # Rodrigues' formula for the smallest turn from u to v.
    cross, cosine = np.cross(u, v), float(u @ v)
    if cosine < -0.9999:
        return np.diag([-1.0, -1.0, 1.0]) * (b / a)
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    return np.asarray((np.eye(3) + skew + skew @ skew / (1 + cosine)) * (b / a))
