# SPDX-License-Identifier: GPL-3.0-or-later
"""What the network sees: for each splat its nearest bones, each described by numbers without unit.

All of it stays the same when the object is turned, moved, scaled or mirrored, and follows the order of bones
and splats.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.bone_roles import bone_roles
from ...rig.segments import BoneSegments, bone_segments
from ...rig.skeleton import Skeleton
from .parts import Parts, label_means
from .tree import BONE_FEATURES, ancestry, bone_features, kinship

Array = NDArray[Any]

TOKENS = 12
"""Bones that a splat may follow: its nearest ones through the body."""

_POOLED = ("near", "wide", "piece", "tight", "loose")
POSITION_FEATURES = (
    "straight", "through", "straight over nearest", "through over nearest", "detour", "along", "clamped",
    "beyond", "over length", "aside", "facing", "axis to surface", "rank", "outward", "faced", "faced over nearest",
)  # fmt: skip
SHARE_FEATURES = (
    "heat", "diffuse heat", "falloff", "owned", "heat share", "closest splat", "strongest heat", "width",
    "heat of kin below", "heat of parent", "parent farther", "children farther", "plain heat", "hard heat",
    "faced falloff",
)  # fmt: skip
CONTEXT_FEATURES = (
    *(f"heat {where}" for where in _POOLED),
    *(f"nearest {where}" for where in _POOLED),
    *(f"below {where}" for where in _POOLED),
)
SPLAT_FEATURES = (
    "distance", "heat entropy", "piece size", "tight size", "loose size", "bones", "second", "pieces",
    "nearest bones in tight", "nearest bones in loose", "thick",
)  # fmt: skip
NAMES = (*POSITION_FEATURES, *SHARE_FEATURES, *BONE_FEATURES, *CONTEXT_FEATURES, *SPLAT_FEATURES)
PRIOR = NAMES.index("heat")
"""The column with the logarithm of the heat weight: where the network's logits start."""


@dataclass(frozen=True)
class Reach:
    """What the bones are to the splats, each (N, B): distances through the body; faced: the same by
    `normal_weighted_distances`; heat, diffuse, hard: equilibria of faced distances with usual, weak and strong
    handles; plain: of plain distances."""

    distances: Array
    faced: Array
    heat: Array
    diffuse: Array
    hard: Array
    plain: Array

    def pick(self, chosen: Any) -> Reach:
        """All of them at `chosen`, an index into them."""
        return Reach(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class Description:
    """The tokens of N splats.

    bone (N, K) int16: the bone of each token, -1 where the skeleton has fewer; values (N, K, F) float32 in the
    order of `NAMES`; relation (B, B) int8, see `kinship`; role (B,) int8, see `bone_roles`.
    """

    bone: Array
    values: Array
    relation: Array
    role: Array


def describe(
    points: Array,
    normals: Array,
    out: Array,
    skeleton: Skeleton,
    reach: Reach,
    parts: Parts,
    size: float,
    *,
    rows: Array | None = None,
    tokens: int = TOKENS,
) -> Description:
    """The description of the splats at `rows` (M,), or of all.

    points, normals (N, 3), the sign of a normal does not matter; out (N, 3): see `outward_normals`; size: the object's
    diagonal.
    """
    rows = np.arange(len(points)) if rows is None else rows
    segments = bone_segments(skeleton)
    bones, count = skeleton.count, min(tokens, skeleton.count)
    distances = np.asarray(reach.distances, np.float32)
    order = np.argsort(distances[rows], axis=1, kind="stable")[:, :count]
    bone = np.full((len(rows), tokens), -1, np.int16)
    bone[:, :count] = order
    at = (np.arange(len(rows))[:, None], order)

    nearest = distances.argmin(axis=1)
    owner = np.zeros((len(points), bones), np.float32)
    owner[np.arange(len(points)), nearest] = 1
    up = ancestry(skeleton.parents)
    below = (up >= 0).astype(np.float32)  # below[a, b]: a hangs on b or is b
    heat = np.asarray(reach.heat, np.float32)
    kin = heat @ below

    position = _position(points[rows], normals[rows], out[rows], skeleton, segments, distances[rows], order, size)
    position = np.concatenate([position, _faced(reach.faced[rows], order, size)], axis=-1)
    share = _share(skeleton, reach, kin, owner, size, rows, at)
    tips = _tips(segments, bones)
    static = bone_features(skeleton, tips, size)[order]
    context = [_log(a[rows][at]) for a in (*parts.pooled(heat), *parts.pooled(owner), *parts.pooled(kin))]
    thick = np.linalg.norm(out, axis=1)
    splat = np.column_stack([_splat(distances, heat, owner, parts, size), thick])[rows]
    splat = np.broadcast_to(splat[:, None], (len(rows), count, splat.shape[1]))
    values = np.zeros((len(rows), tokens, len(NAMES)), np.float32)
    values[:, :count] = np.concatenate([position, share, static, np.stack(context, -1), splat], axis=-1)
    return Description(bone, values, kinship(skeleton.parents), bone_roles(skeleton.names))


def _log(share: Array) -> Array:
    return np.log(np.maximum(share, 0) + np.float32(1e-3))


def _tips(segments: BoneSegments, bones: int) -> Array:
    """(B, 3): the mean of the ends of each bone's segments."""
    size = np.bincount(segments.bone, minlength=bones)
    return np.stack([np.bincount(segments.bone, segments.ends[:, k], bones) / size for k in range(3)], axis=1)


def _position(
    points: Array, normals: Array, out: Array, skeleton: Skeleton, segments: BoneSegments, distances: Array,
    order: Array, size: float,
) -> Array:  # fmt: skip
    """(M, K, C): where a splat lies, seen from a bone; the first of `POSITION_FEATURES`."""
    shape = (len(points), skeleton.count)
    straight = np.full(shape, np.inf, np.float32)
    along, length = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    facing, flat, back = (np.zeros(shape, np.float32) for _ in range(3))
    for start, end, bone in zip(segments.starts, segments.ends, segments.bone, strict=True):
        axis = end - start
        reach = max(float(np.linalg.norm(axis)), 1e-6 * size)
        axis = axis / reach
        away = points - start
        t = away @ axis
        aside = away - t.clip(0, reach)[:, None] * axis
        way = np.linalg.norm(aside, axis=1)
        better = way < straight[:, bone]
        for target, value in (
            (straight, way),
            (along, t / reach),
            (length, np.full(len(t), reach)),
            (facing, np.abs((aside * normals).sum(1)) / np.maximum(way, 1e-9 * size)),
            (flat, np.abs(normals @ axis)),
            (back, (aside * out).sum(1) / np.maximum(way, 1e-9 * size)),
        ):
            target[better, bone] = value[better]
    at = (np.arange(len(points))[:, None], order)
    floor = 1e-3 * size
    e, g = np.maximum(straight[at], floor), np.maximum(distances[at], floor)
    t, reach = along[at], length[at]
    ends = np.maximum(-t, t - 1)
    columns = [
        np.log(e / size),
        np.log(g / size),
        np.log(e / e.min(axis=1, keepdims=True)),
        np.log(g / g.min(axis=1, keepdims=True)),
        np.log(np.maximum(g / e, 1)).clip(0, 3),
        t.clip(-2, 3),
        t.clip(0, 1),
        (ends * reach / size).clip(-0.2, 0.4) * 5,
        np.log(g / reach).clip(-3, 3),
        np.log(np.sqrt(np.maximum(e**2 - (np.maximum(ends, 0) * reach) ** 2, floor**2)) / size),
        facing[at],
        flat[at],
        np.broadcast_to(np.arange(order.shape[1]) / 16, order.shape),
        back[at],
    ]
    return np.stack([np.asarray(c, np.float32) for c in columns], axis=-1)


def _faced(faced: Array, order: Array, size: float) -> Array:
    """(M, K, 2): the rest of `POSITION_FEATURES`."""
    way = np.log(faced[np.arange(len(faced))[:, None], order] / size)
    over = way - np.log(faced.min(axis=1) / size)[:, None]
    return np.stack([way.clip(-8, 3), over.clip(0, 6)], axis=-1).astype(np.float32)


def _falloff(near: Array) -> Array:
    """(N, B): logarithm of the shares that fall with the fourth power of distances `near` (N, B)."""
    ratio = (near.min(axis=1, keepdims=True) / near) ** 4
    return np.asarray(_log(ratio / ratio.sum(axis=1, keepdims=True)))


def _share(
    skeleton: Skeleton, reach: Reach, kin: Array, owner: Array, size: float, rows: Array, at: Any
) -> Array:
    """(M, K, len(SHARE_FEATURES)): how much of the splat, and of the whole object, a bone claims."""
    parents, order = skeleton.parents, at[1]
    floor = np.float32(1e-3 * size)
    near, heat = np.maximum(np.asarray(reach.distances, np.float32), floor), np.asarray(reach.heat, np.float32)
    owned = owner.mean(axis=0)
    own_width = (owner * near).sum(axis=0) / np.maximum(owner.sum(axis=0), 1)
    has = parents >= 0
    above = np.where(has, parents, 0)
    children = np.full_like(near, np.inf)
    for bone in np.flatnonzero(has):
        np.minimum(children[:, parents[bone]], near[:, bone], out=children[:, parents[bone]])
    bone_columns = np.stack(
        [
            np.log(owned + 1e-4), np.log(heat.mean(axis=0) + 1e-4), np.log(near.min(axis=0) / size),
            _log(heat.max(axis=0)), np.log(own_width / size + 1e-3),
        ], axis=-1,
    )[order]  # fmt: skip
    mine = near[rows][at]
    parent_heat = np.where(has[order], heat[rows[:, None], above[order]], 0)
    parent_way = np.where(has[order], np.log(near[rows[:, None], above[order]] / mine), 0)
    child_way = children[rows][at]
    child_way = np.where(np.isfinite(child_way), np.log(np.minimum(child_way, 1e9) / mine), 0)
    first = np.stack([_log(heat[rows][at]), _log(reach.diffuse[rows][at]), _falloff(near)[rows][at]], axis=-1)
    plain, hard = _log(reach.plain[rows][at]), _log(reach.hard[rows][at])
    faced = _falloff(np.asarray(reach.faced, np.float32))[rows][at]
    last = np.stack([_log(kin[rows][at]), _log(parent_heat), parent_way, child_way, plain, hard, faced], axis=-1)
    return np.concatenate([first, bone_columns, last], axis=-1).astype(np.float32)


def _splat(distances: Array, heat: Array, owner: Array, parts: Parts, size: float) -> Array:
    """(N, len(SPLAT_FEATURES)): the splat itself and the parts that it belongs to."""
    count, bones = distances.shape
    ranked = np.sort(distances, axis=1)[:, :2] if bones > 1 else np.repeat(distances, 2, axis=1)
    ranked = np.maximum(ranked, 1e-3 * size)
    entropy = -(heat * np.log(heat + 1e-6)).sum(axis=1)
    sizes = [np.bincount(label)[label] / count for label in parts.labels.T]
    spread = []
    for label in parts.labels.T[1:]:
        own = label_means(owner, label)
        spread.append(np.exp(-(own * np.log(own + 1e-6)).sum(axis=1))[label])
    pieces = np.log((np.bincount(parts.labels[:, 0]) > 2e-3 * count).sum() + 1.0)
    columns = [
        np.log(ranked[:, 0] / size), entropy, *(np.log(s) for s in sizes),
        np.full(count, np.log(bones) / 3), np.log(ranked[:, 1] / ranked[:, 0]).clip(0, 4),
        np.full(count, pieces), *(np.log(s) for s in spread),
    ]  # fmt: skip
    return np.stack([np.asarray(c, np.float32) for c in columns], axis=1)
