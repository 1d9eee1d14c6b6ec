# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights of made-up bodies: by depth in the flesh, by nearness to bones, or as artists' automatic weights do, by heat.

Flesh shares weight between its bone and the bones next to it in the tree, its kin; rigid parts follow their bone alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.skeleton import Skeleton
from .flesh import Flesh, Plan

Array = NDArray[Any]

RULES = ("depth", "nearness", "heat")
OFTEN = (0.45, 0.25, 0.3)
"""How often each rule is drawn."""
HEAT_NODES = 1500
LINKS = 8


def blend(plan: Plan, skeleton: Skeleton, points: Array, part: Array, rule: str | None = None) -> Array:
    """Weights (N, B), rows sum to 1, of points (N, 3) on the parts (N,) of a plan's flesh; a random rule by default."""
    rng = plan.rng
    rule = rule or RULES[rng.choice(len(RULES), p=OFTEN)]
    kin = _kinship(skeleton)
    soft, power, strength = rng.uniform(0.08, 0.5), rng.uniform(3.0, 8.0), np.exp(rng.uniform(-1.0, 1.5))
    weights = np.zeros((len(points), skeleton.count))
    warm = _heat(plan, skeleton, points, part, kin, strength) if rule == "heat" else None
    for number, flesh in enumerate(plan.flesh):
        rows = np.flatnonzero(part == number)
        if flesh.drape:
            own = _draped(flesh, skeleton, points[rows])
        elif flesh.rigid:
            own = np.eye(skeleton.count)[np.full(len(rows), flesh.bone)]
        elif warm is not None:
            own = warm[rows]
        elif rule == "nearness":
            near = np.flatnonzero(kin[flesh.bone] & _covered(plan, skeleton.count))
            own = np.zeros((len(rows), skeleton.count))
            own[:, near] = _nearness(skeleton, points[rows], near, power)
        else:
            own = _by_depth(plan, flesh, points[rows], kin, soft)
        weights[rows] = own / np.maximum(own.sum(axis=1, keepdims=True), 1e-30)
    return weights


def _kinship(skeleton: Skeleton) -> Array:
    """(B, B) bool: the same bone, or parent and child."""
    kin = np.eye(skeleton.count, dtype=bool)
    has = np.flatnonzero(skeleton.parents >= 0)
    kin[has, skeleton.parents[has]] = kin[skeleton.parents[has], has] = True
    return kin


def _covered(plan: Plan, bones: int) -> Array:
    """(B,) bool: the bones with soft flesh."""
    out = np.zeros(bones, bool)
    out[[flesh.bone for flesh in plan.flesh if not flesh.rigid]] = True
    return out


def _by_depth(plan: Plan, own: Flesh, points: Array, kin: Array, soft: float) -> Array:
    """By how deep a point lies in the flesh of each bone, relative to its own flesh's thickness."""
    out = np.zeros((len(points), len(kin)))
    for flesh in plan.flesh:
        if kin[own.bone, flesh.bone] and not flesh.rigid:
            depth = flesh.local(points)[1] / (soft * (own.r0 + own.r1))
            out[:, flesh.bone] = np.maximum(out[:, flesh.bone], np.exp(-depth.clip(-20, 20) * 2))
    return out


def _draped(flesh: Flesh, skeleton: Skeleton, points: Array) -> Array:
    out = np.zeros((len(points), skeleton.count))
    share = flesh.sag * flesh.local(points)[0]
    legs = _nearness(skeleton, points, np.array(flesh.drape), 4.0)
    out[:, flesh.drape] = share[:, None] * legs / legs.sum(axis=1, keepdims=True)
    out[:, flesh.bone] += 1 - share
    return out


def _way(skeleton: Skeleton, points: Array, bones: Array) -> Array:
    """Distances (N, len(bones)) to bones."""
    start = skeleton.heads[bones]
    axis = skeleton.tails[bones] - start
    away = points[:, None] - start
    t = ((away * axis).sum(-1) / np.maximum((axis * axis).sum(-1), 1e-12)).clip(0, 1)
    out: Array = np.linalg.norm(away - t[..., None] * axis, axis=-1) + 1e-3
    return out


def _nearness(skeleton: Skeleton, points: Array, bones: Array, power: float) -> Array:
    """(N, len(bones)): a power of how near each bone is, 1 for the nearest."""
    way = _way(skeleton, points, bones)
    out: Array = (way.min(axis=1, keepdims=True) / way) ** power
    return out


def _heat(plan: Plan, skeleton: Skeleton, points: Array, part: Array, kin: Array, strength: float) -> Array:
    """Heat equilibrium over a graph of some points, each heated by the nearest of its kin (Baran & Popovic 2007)."""
    from scipy import sparse
    from scipy.sparse.linalg import splu
    from scipy.spatial import cKDTree

    bone = np.array([flesh.bone for flesh in plan.flesh])[part]
    nodes = plan.rng.permutation(len(points))[:HEAT_NODES]
    tree = cKDTree(points[nodes])
    way, near = tree.query(points, min(LINKS + 1, len(nodes)))
    linked = kin[bone[:, None], bone[nodes][near]]
    a = np.repeat(np.arange(len(nodes)), near.shape[1])
    b, joined, square = near[nodes].ravel(), linked[nodes].ravel(), np.square(way[nodes]).ravel()
    keep = joined & (a != b)
    a, b, square = a[keep], b[keep], square[keep]
    count = len(nodes)
    links = sparse.coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), (count, count)).tocsr()
    mass = (np.bincount(a, square, count) + np.bincount(b, square, count)) / 4 + 1e-9
    distance = np.where(kin[bone[nodes]], _way(skeleton, points[nodes], np.arange(skeleton.count)), np.inf)
    source, closest = distance.argmin(axis=1), distance.min(axis=1)
    handle = strength * mass / closest**2
    system = sparse.diags(np.asarray(links.sum(axis=1)).ravel() + handle) - links
    given = np.zeros((count, skeleton.count))
    given[np.arange(count), source] = handle
    heat = splu(system.tocsc()).solve(given)
    share = np.where(linked, 1 / (way + 1e-6), 0)
    share[~linked.any(axis=1), 0] = 1
    out: Array = np.einsum("nk,nkb->nb", share, heat[near])
    return out
