# SPDX-License-Identifier: GPL-3.0-or-later
"""Left and right of a skeleton: which bone mirrors which, and the plane between them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .skeleton import Skeleton

Array = NDArray[Any]

CLOSE = 0.04
"""Bones mirror one another by place where their ends do within this share of the skeleton's diagonal."""

_TOKENS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[A-Z]|\d+|[^A-Za-z\d]+")
_OTHER = {"left": "right", "right": "left", "l": "r", "r": "l"}


def mirrored_name(name: str) -> str:
    """The name of the bone on the other side; the same name where it has no side.

    Sides are `left`, `right`, `l` and `r` as words of their own, in any case: Hand.L, l_hand, LeftArm, J_Bip_R_Hand,
    lShldr.
    """
    tokens: list[str] = _TOKENS.findall(name)
    for token in ("left", "right", "l", "r"):
        for place, found in enumerate(tokens):
            if found.lower() == token:
                other = _OTHER[token]
                turned = other.upper() if found.isupper() else other.title() if found.istitle() else other
                return "".join([*tokens[:place], turned, *tokens[place + 1 :]])
    return name


def side_of_name(name: str) -> str:
    """"left", "right" or "" for a bone's name."""
    other = mirrored_name(name)
    if other == name:
        return ""
    tokens = {token.lower() for token in _TOKENS.findall(name)}
    words = tokens & {"left", "right"} or tokens & {"l", "r"}
    return "left" if words & {"left", "l"} else "right"


def mirror_plane(skeleton: Skeleton) -> tuple[Array, Array]:
    """Point (3,) and unit normal (3,) of the plane between the sides of a skeleton; the normal points to its left.

    From the bones whose names have a partner on the other side.

    Raises:
        InputError: no two bones are named as left and right.
    """
    place = {name: index for index, name in enumerate(skeleton.names)}
    pairs = [
        (index, place[mirrored_name(name)])
        for name, index in place.items()
        if side_of_name(name) == "left" and mirrored_name(name) in place
    ]
    ends = np.stack([skeleton.heads, skeleton.tails], axis=1)
    across = np.array([ends[left] - ends[right] for left, right in pairs]).reshape(-1, 3)
    middle = np.array([(ends[left] + ends[right]) / 2 for left, right in pairs]).reshape(-1, 3)
    size = float(np.abs(across).max(initial=0))
    if size <= 0:
        raise InputError(
            "No bones are named as left and right of one another (such as Arm.L and Arm.R); rename the bones, then "
            "mirror again."
        )
    normal = np.linalg.svd(across, full_matrices=False)[2][0]
    normal *= 1.0 if float((across @ normal).sum()) >= 0 else -1.0
    return middle.mean(axis=0), normal


def mirror_partners(skeleton: Skeleton, point: Array, normal: Array) -> Array:
    """(B,) int64: the bone that mirrors each bone, itself on the plane, -1 where there is none.

    By name; bones without a side by place: those whose mirrored ends lie on the ends of another bone or of their own.
    point, normal (3,): the plane, see `mirror_plane`.
    """
    names, heads, tails = skeleton.names, skeleton.heads, skeleton.tails
    place = {name: index for index, name in enumerate(names)}
    partner = np.array([place.get(mirrored_name(name), -1) if side_of_name(name) else -1 for name in names], np.int64)
    ends = np.concatenate([heads, tails])
    close = CLOSE * float(np.linalg.norm(ends.max(axis=0) - ends.min(axis=0)))
    there = np.concatenate([mirrored(heads, point, normal), mirrored(tails, point, normal)], axis=1)
    here = np.concatenate([heads, tails], axis=1)
    open_ = np.flatnonzero(partner < 0)
    if len(open_):
        off = there[open_, None] - here[None, open_]
        worst = np.maximum(np.linalg.norm(off[..., :3], axis=2), np.linalg.norm(off[..., 3:], axis=2))
        best = worst.argmin(axis=1)
        mutual = (best[best] == np.arange(len(open_))) & (worst[np.arange(len(open_)), best] <= close)
        partner[open_[mutual]] = open_[best[mutual]]
    return partner


def mirror_targets(skeleton: Skeleton, point: Array, normal: Array) -> Array:
    """(B,) int64: the bone that gets on the other side what each bone has on this one.

    Its partner, see `mirror_partners`. A bone of one side alone, such as that of a shield, has none: what it moves goes
    on the other side with the partner of the bone that carries it. Others without a partner stand for themselves.
    """
    partner = mirror_partners(skeleton, point, normal)
    ends = np.concatenate([skeleton.heads, skeleton.tails])
    close = CLOSE * float(np.linalg.norm(ends.max(axis=0) - ends.min(axis=0)))
    off = (np.stack([skeleton.heads, skeleton.tails]) - point) @ normal
    aside = (off > close).all(axis=0) | (off < -close).all(axis=0)
    target = np.empty(skeleton.count, np.int64)
    for bone, parent in enumerate(skeleton.parents.tolist()):  # parents come first
        target[bone] = partner[bone] if partner[bone] >= 0 else bone
        if partner[bone] < 0 and parent >= 0 and (side_of_name(skeleton.names[bone]) or aside[bone]):
            target[bone] = target[parent]
    return target


def mirrored(points: Array, point: Array, normal: Array) -> Array:
    """points (N, 3) on the other side of the plane through point (3,) with the unit normal (3,)."""
    points = np.asarray(points, np.float64)
    return np.asarray(points - 2 * ((points - point) @ normal)[:, None] * normal)

