# SPDX-License-Identifier: GPL-3.0-or-later
"""A made-up figure with any number of splats and bones and known weights, for benchmarks that need no assets."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.from_mesh import sample_mesh

from .assets import RiggedSplats

_LIMBS = (
    # (start, end, radius at the start and end, limb that it hangs on)
    ((0.0, 0.0, 0.9), (0.0, 0.0, 1.45), (0.16, 0.19), -1),
    ((0.17, 0.0, 1.38), (0.80, 0.0, 1.0), (0.08, 0.045), 0),
    ((-0.17, 0.0, 1.38), (-0.80, 0.0, 1.0), (0.08, 0.045), 0),
    ((0.10, 0.0, 0.88), (0.18, 0.0, 0.05), (0.10, 0.05), 0),
    ((-0.10, 0.0, 0.88), (-0.18, 0.0, 0.05), (0.10, 0.05), 0),
    ((0.0, 0.0, 1.45), (0.0, 0.0, 1.80), (0.07, 0.13), 0),
    ((0.0, 0.10, 0.90), (0.0, 0.75, 0.75), (0.07, 0.03), 0),
)
"""Trunk, arms, legs, head, tail; metres."""


def figure(splats: int, bones: int, seed: int = 0) -> RiggedSplats:
    """A person of tubes with a tail: `splats` splats, `bones` bones (at least 5), weights that blend at the joints.

    The limbs' bones are chains; the longer limb has the more of them.
    """
    limbs = _LIMBS[: min(bones, len(_LIMBS))]
    length = np.array([np.linalg.norm(np.subtract(b, a)) for a, b, _, _ in limbs])
    share = np.ones(len(limbs), int)
    while share.sum() < bones:
        share[np.argmax(length / share)] += 1
    first = np.concatenate([[0], np.cumsum(share)])
    joints = [np.linspace(a, b, n + 1) for (a, b, _, _), n in zip(limbs, share, strict=True)]
    parents = [
        first[limb] + k - 1 if k else (-1 if hangs < 0 else int(first[hangs] + (share[hangs] - 1) * (start[2] > 1.2)))
        for limb, (start, _, _, hangs) in enumerate(limbs)
        for k in range(share[limb])
    ]
    skeleton = Skeleton(
        names=tuple(f"bone.{k}" for k in range(bones)),
        parents=np.array(parents),
        heads=np.concatenate([j[:-1] for j in joints]),
        tails=np.concatenate([j[1:] for j in joints]),
        rest=np.tile(np.eye(4), (bones, 1, 1)),
    )
    verts, faces, along = [], [], []
    for limb, (start, end, radius, _) in enumerate(limbs):
        v, f, t = _tube(np.array(start), np.array(end), radius)
        faces.append(f + sum(len(part) for part in verts))
        verts.append(v)
        along.append(first[limb] + np.clip(t * share[limb], 0, share[limb] - 1e-9))
    place = np.concatenate(along)
    limb_of = np.repeat(np.arange(len(limbs)), [len(v) for v in verts])
    points, triangles = np.concatenate(verts), np.concatenate(faces)
    corner = points[triangles]
    rgb = 0.5 + 0.4 * np.stack([np.sin(21 * corner.sum(-1)), np.cos(17 * corner[..., 2]), np.sign(corner[..., 1])], -1)
    cloud, face, bary = sample_mesh(points, triangles, rgb, splats, np.random.default_rng(seed))
    weights = np.einsum("nk,nkb->nb", bary, _blend(place, limb_of, first)[triangles[face]])
    weights /= weights.sum(axis=1, keepdims=True)
    return RiggedSplats(f"figure-{splats}-{bones}", cloud, skeleton, weights.astype(np.float32), None)


def _tube(
    start: NDArray[np.float64], end: NDArray[np.float64], radius: tuple[float, float], rings: int = 40, sides: int = 20
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Vertices, triangles, and where along the tube (0 to 1) each vertex lies; closed by caps of tiny rings."""
    way = (end - start) / np.linalg.norm(end - start)
    side = np.cross(way, [0.0, 1.0, 0.0] if abs(way[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    t = np.concatenate([[0.0], np.linspace(0, 1, rings), [1.0]])
    wide = np.concatenate([[1e-3], np.linspace(*radius, rings), [1e-3]])
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(way, side)
    verts = (start + t[:, None] * (end - start))[:, None] + wide[:, None, None] * circle
    i, j = np.meshgrid(np.arange(len(t) - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + j).ravel(), (i * sides + (j + 1) % sides).ravel()
    faces = np.concatenate([np.stack([a, a + sides, b], 1), np.stack([b, a + sides, b + sides], 1)])
    return verts.reshape(-1, 3), faces, np.repeat(t, sides)


def _blend(place: NDArray[np.float64], limb: NDArray[np.int64], first: NDArray[np.int64]) -> NDArray[np.float64]:
    """Weights (V, B): one in the middle of each bone, half and half at a joint within a limb."""
    weights = np.zeros((len(place), first[-1]))
    for number, (low, high) in enumerate(pairwise(first)):
        rows = np.flatnonzero(limb == number)
        bone = np.minimum(place[rows].astype(int), high - 1)
        part = place[rows] - bone
        other = np.clip(bone + np.where(part < 0.5, -1, 1), low, high - 1)
        share = np.clip(np.abs(part - 0.5) - 0.25, 0, 0.25) * 2
        np.add.at(weights, (rows, other), share)
        np.add.at(weights, (rows, bone), 1 - share)
    return weights
