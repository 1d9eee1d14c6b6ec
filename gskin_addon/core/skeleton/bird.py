# SPDX-License-Identifier: GPL-3.0-or-later
"""Joints of a bird by its outline alone: beak, tail, feet and wing tips are ends, the rest lies between by proportion.

There are too few rigged birds under free licences to learn from. A body here stands on z = 0 and looks along -y.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_SPREAD = 0.9
"""Wings are spread where the body is so much wider than long."""


def bird_front(turns: list[Array]) -> int:
    """Which of four bodies, points (M, 3) turned by quarters about z, looks along -y: its halves mirror across x, and
    what is highest, the head, lies before the middle."""
    alike = [_mirrors(points) for points in turns[:2]]
    across = int(np.argmax(alike))
    points = turns[across]
    top = points[points[:, 2] >= np.percentile(points[:, 2], 90)]
    ahead = float(top[:, 1].mean() - np.median(points[:, 1]))
    return across if ahead <= 0 else across + 2


def bird_joints(surface: Array) -> dict[str, Array]:
    """The joints of `layouts.BIRD` of a bird with surface points (M, 3)."""
    low, high = surface.min(axis=0), surface.max(axis=0)
    size = high - low
    trunk = _trunk(surface, size)
    beak, head = _head(surface, trunk, size)
    tail_tip = surface[(surface[:, 1] - 0.3 * np.abs(surface[:, 0])).argmax()] * np.array([0.0, 1.0, 1.0])
    hips = trunk + np.array([0.0, 0.12 * size[1], 0.0])
    neck = trunk + 0.45 * (head - trunk)
    points = {"hips": hips, "neck": neck, "head": head, "beak": beak, "tail": hips + 0.35 * (tail_tip - hips)}
    points["tail_tip"] = tail_tip
    for side, sign in (("L", 1.0), ("R", -1.0)):
        points |= {f"{name}.{side}": place for name, place in _leg(surface, trunk, hips, size, sign).items()}
        points |= {f"{name}.{side}": place for name, place in _wing(surface, trunk, hips, size, sign).items()}
    return points


def _mirrors(points: Array) -> float:
    """How much of a body at points (M, 3) its mirror image across x covers, 0 to 1."""
    own = points - np.array([(points[:, 0].min() + points[:, 0].max()) / 2, 0, 0])
    cell = float(np.ptp(own, axis=0).max()) / 24 or 1.0

    def voxels(places: Array) -> set[tuple[int, ...]]:
        return {tuple(place) for place in np.rint(places / cell).astype(int).tolist()}

    here, there = voxels(own), voxels(own * np.array([-1, 1, 1]))
    return len(here & there) / max(len(here), 1)


def _trunk(surface: Array, size: Array) -> Array:
    """The middle of the thickest part: what is left without wings, legs, neck and tail."""
    inner = surface[np.abs(surface[:, 0]) < 0.25 * size[1] + 0.05 * size[0]]
    cuts = np.linspace(inner[:, 1].min(), inner[:, 1].max(), 13)
    best, place = -1.0, np.zeros(3)
    for back, front in zip(cuts[:-2], cuts[2:], strict=True):
        part = inner[(inner[:, 1] >= back) & (inner[:, 1] <= front)]
        upper = part[part[:, 2] > 0.25 * size[2]]
        if len(upper) < 8:
            continue
        low, high = np.percentile(upper, [5, 95], axis=0)
        girth = float((high[0] - low[0]) * (high[2] - low[2]))
        if girth > best:
            best, place = girth, (low + high) / 2
    return np.asarray(place * np.array([0.0, 1.0, 1.0]))


def _head(surface: Array, trunk: Array, size: Array) -> tuple[Array, Array]:
    """Beak, the foremost of what is high, and the head's joint behind it."""
    near = surface[np.abs(surface[:, 0]) < 0.2 * max(size[1], size[2])]
    ahead = near[near[:, 1] < trunk[1]]
    if not len(ahead):
        ahead = near
    beak = ahead[(-ahead[:, 1] / max(size[1], 1e-9) + 0.7 * ahead[:, 2] / max(size[2], 1e-9)).argmax()]
    beak = beak * np.array([0.0, 1.0, 1.0])
    return beak, np.asarray(beak + 0.3 * (trunk - beak) * np.array([0.0, 1.0, 0.4]))


def _leg(surface: Array, trunk: Array, hips: Array, size: Array, sign: float) -> dict[str, Array]:
    own = surface[(sign * surface[:, 0] > 0) & (surface[:, 2] < 0.1 * size[2])]
    foot = own.mean(axis=0) if len(own) > 2 else np.array([0.1 * sign * size[1], hips[1], 0.0])
    spread = sign * max(abs(float(foot[0])), 0.05 * float(size[1]))
    top = np.array([spread, hips[1] * 0.5 + trunk[1] * 0.5, min(trunk[2] * 0.9, 0.6 * size[2])])
    front = own[:, 1].min() if len(own) > 2 else foot[1] - 0.1 * size[1]
    ankle = np.array([foot[0], foot[1] + 0.02 * size[1], 0.25 * top[2]])
    knee = top + 0.5 * (ankle - top) - np.array([0.0, 0.06 * size[1], 0.0])
    toe = np.array([foot[0], foot[1], 0.02 * size[2]])
    return {
        "thigh": top, "shin": knee, "foot": ankle, "toe": toe, "toe_tip": np.array([foot[0], front, 0.0]),
        "hip_bone": np.array([top[0], hips[1], hips[2]]),
    }  # fmt: skip


def _wing(surface: Array, trunk: Array, hips: Array, size: Array, sign: float) -> dict[str, Array]:
    own = surface[(sign * surface[:, 0] > 0) & (surface[:, 2] > 0.3 * trunk[2])]
    shoulder = trunk + np.array([sign * 0.08 * min(size[0], size[1]), -0.08 * size[1], 0.06 * size[2]])
    if size[0] > _SPREAD * size[1] and len(own):
        tip = own[(sign * own[:, 0]).argmax()]
        wrist = shoulder + 0.55 * (tip - shoulder) - np.array([0.0, 0.05 * size[1], 0.0])
    else:  # folded: along the side of the trunk to the tail
        side = float(np.percentile(sign * own[:, 0], 95)) if len(own) else 0.1 * float(size[1])
        shoulder = np.array([sign * 0.7 * side, shoulder[1], shoulder[2]])
        tip = np.array([sign * 0.6 * side, hips[1] + 0.1 * size[1], hips[2]])
        wrist = np.array([sign * side, trunk[1] - 0.12 * size[1], trunk[2] - 0.03 * size[2]])
    return {"wing": shoulder, "wing_elbow": shoulder + 0.5 * (wrist - shoulder) + np.array([0, 0.03 * size[1], 0]),
            "wing_wrist": wrist, "wing_tip": tip}  # fmt: skip
