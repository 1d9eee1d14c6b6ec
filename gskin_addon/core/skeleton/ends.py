# SPDX-License-Identifier: GPL-3.0-or-later
"""Where limbs end and what lies between joints: crown, fingertips, toes, heels, muzzle, told from joints and surface.

A body here stands on z = 0 and looks along -y, as `stance.Standing` has it; lengths in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_SIDES = (("L", 1.0), ("R", -1.0))


def human_ends(joints: dict[str, Array], surface: Array) -> dict[str, Array]:
    """The points of `layouts.HUMAN` from the joints of `both_sides(joints.HUMAN)`; surface (M, 3): of the body."""
    points = dict(joints)
    hips, neck, head = joints["hips"], joints["neck"], joints["head"]
    trunk = float(np.linalg.norm(neck - hips))
    chest = hips + 0.7 * (neck - hips)
    points["collar"] = neck + 0.25 * (chest - neck)
    points["crown"] = tip(head, head - neck, surface, 0.45 * trunk, spread=0.8)
    for side, sign in _SIDES:
        wrist, elbow = joints[f"wrist.{side}"], joints[f"elbow.{side}"]
        forearm = float(np.linalg.norm(wrist - elbow))
        points[f"fingers.{side}"] = tip(wrist, wrist - elbow, surface, 0.75 * forearm, least=0.25 * forearm)
        _foot(points, side, sign, joints[f"ankle.{side}"], joints[f"toe.{side}"], surface)
        shoulder, thigh = joints[f"shoulder.{side}"], joints[f"thigh.{side}"]
        front = np.array([0.0, -0.25 * trunk, 0.0])
        points[f"breast.{side}"] = chest + 0.5 * np.array([shoulder[0] - chest[0], 0.0, 0.0])
        points[f"nipple.{side}"] = points[f"breast.{side}"] + front
        points[f"hip_bone.{side}"] = thigh + np.array([sign * 0.02, -0.15, 0.2]) * trunk
    return points


def quadruped_ends(joints: dict[str, Array], surface: Array) -> dict[str, Array]:
    """The points of `layouts.QUADRUPED` from the joints of `both_sides(joints.QUADRUPED)`."""
    points = dict(joints)
    hips, neck, head, tail = (joints[name] for name in ("hips", "neck", "head", "tail"))
    trunk = float(np.linalg.norm(neck - hips))
    points["muzzle"] = tip(head, np.array([0.0, -1.0, -0.3]), surface, 0.5 * trunk, least=0.12 * trunk, spread=0.7)
    points["tail_tip"] = tail_tip(tail, surface, trunk)
    chest = hips + 0.8 * (neck - hips)
    for side, sign in _SIDES:
        thigh = joints[f"thigh.{side}"]
        for kind in ("front_", ""):
            paw = joints[f"{kind}toe.{side}"]
            points[f"{kind}toe_tip.{side}"] = toe_tip(paw, np.array([0.0, -1.0, 0.0]), surface, 0.12 * trunk)
        top, carpus = joints[f"front_thigh.{side}"], joints[f"front_foot.{side}"]
        points[f"front_shin.{side}"] = top + 0.45 * (carpus - top) + np.array([0.0, 0.03, 0.0]) * trunk
        points[f"blade.{side}"] = np.array([(top[0] + chest[0]) / 2, chest[1], max(chest[2], top[2] + 0.1 * trunk)])
        points[f"breast.{side}"] = chest + np.array([0.3 * (top[0] - chest[0]), 0.0, -0.1 * trunk])
        points[f"nipple.{side}"] = points[f"breast.{side}"] + np.array([0.0, -0.1, -0.15]) * trunk
        points[f"hip_bone.{side}"] = thigh + np.array([sign * 0.01, -0.05, 0.12]) * trunk
    return points


def tip(
    start: Array, way: Array, surface: Array, reach: float, *, least: float = 0.0, spread: float = 0.6
) -> Array:
    """The end of what goes on from a joint at start (3,) along way (3,): the farthest surface in a widening cone.

    No farther than `reach` and no nearer than `least`; spread: of the cone, its width for each length.
    """
    ahead = np.asarray(way, np.float64) / max(float(np.linalg.norm(way)), 1e-12)
    off = surface - start
    along = off @ ahead
    aside = np.linalg.norm(off - along[:, None] * ahead, axis=1)
    inside = (along > 0) & (along < reach) & (aside < 0.1 * reach + spread * along)
    if not inside.any():
        return np.asarray(start + max(least, 0.3 * reach) * ahead)
    far = max(float(np.percentile(along[inside], 99)), least)
    last = inside & (along > 0.85 * far)
    middle = off[last].mean(axis=0) if last.any() else far * ahead
    middle -= (middle @ ahead) * ahead
    return np.asarray(start + far * ahead + 0.5 * middle)


def tail_tip(start: Array, surface: Array, trunk: float) -> Array:
    """The end of a tail that begins at start (3,): the farthest surface behind it near the middle; a stub without."""
    off = surface - start
    behind = (off[:, 1] > 0) & (np.abs(off[:, 0]) < 0.15 * trunk + 0.3 * off[:, 1])
    behind &= off[:, 2] > -np.maximum(0.5 * trunk, 2.0 * off[:, 1])
    if behind.any():
        length = np.linalg.norm(off[behind], axis=1)
        if length.max() > 0.1 * trunk:
            return np.asarray(surface[behind][length.argmax()])
    return np.asarray(start + np.array([0.0, 0.1, -0.05]) * trunk)


def toe_tip(start: Array, way: Array, surface: Array, reach: float) -> Array:
    """The front of a foot whose toes begin at start (3,), near the floor."""
    ahead = np.array([way[0], way[1], 0.0])
    ahead /= max(float(np.linalg.norm(ahead)), 1e-12)
    off = surface - start
    along = off @ ahead
    aside = np.linalg.norm(off[:, :2] - along[:, None] * ahead[:2], axis=1)
    inside = (along > 0) & (along < 2 * reach) & (aside < reach) & (off[:, 2] < 0.5 * reach)
    far = float(np.percentile(along[inside], 98)) if inside.any() else reach
    out = start + max(far, 0.3 * reach) * ahead
    out[2] = max(start[2] * 0.7, 0.0)
    return np.asarray(out)


def _foot(points: dict[str, Array], side: str, sign: float, ankle: Array, toe: Array, surface: Array) -> None:
    """Toe tip and heel of a person's foot."""
    way = toe - ankle
    length = max(float(np.linalg.norm(way[:2])), 1e-9)
    points[f"toe_tip.{side}"] = toe_tip(toe, way, surface, 0.6 * length)
    back = ankle - 0.35 * way * np.array([1.0, 1.0, 0.0])
    across = np.array([-way[1], way[0], 0.0]) / length * 0.35 * length  # to the outside of the left foot
    across = across * (1.0 if across[0] > 0 else -1.0) * sign
    points[f"heel_inner.{side}"] = np.array([*(back - across)[:2], 0.0])
    points[f"heel_outer.{side}"] = np.array([*(back + across)[:2], 0.0])
