# SPDX-License-Identifier: GPL-3.0-or-later
"""Random changes to the proportions and rest poses of rigged meshes: longer arms, thinner legs, bent knees.

The weights of the vertices stay. So a family of characters that all have one build can teach many builds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.kinematics import joints_posed
from ...rig.poses import random_axes
from ...rig.quaternion import axis_angle_to_matrix
from ...rig.skeleton import Skeleton
from ..rigged import RiggedMesh

Array = NDArray[Any]

STRETCH, GIRTH, BEND = 0.25, 0.18, 14.0
"""Standard deviations of the logarithm of a bone's length and of the width around it, and of a joint's angle in
degrees."""


def change_proportions(mesh: RiggedMesh, rng: np.random.Generator) -> RiggedMesh:
    """The mesh with every bone stretched, made wider or thinner, and turned about its head, all at random."""
    count = mesh.skeleton.count
    strength = rng.random(3)
    stretch = np.exp(strength[0] * STRETCH * rng.normal(size=count).clip(-2, 2))
    girth = np.exp(strength[1] * GIRTH * rng.normal(size=count).clip(-2, 2))
    axes = random_axes(count, rng)
    angles = np.radians(strength[2] * BEND * rng.normal(size=count).clip(-2.5, 2.5))
    transforms = proportion_transforms(mesh.skeleton, stretch, girth, axis_angle_to_matrix(axes, angles))
    skeleton = mesh.skeleton
    heads, tails = joints_posed(skeleton, transforms)
    # Not skin_points: a vertex without weights stays where it is.
    verts = mesh.verts + np.einsum("vb,vbk->vk", mesh.weights, _moves(transforms, mesh.verts))
    return replace(mesh, verts=verts, skeleton=Skeleton(skeleton.names, skeleton.parents, heads, tails))


def proportion_transforms(skeleton: Skeleton, stretch: Array, girth: Array, turns: Array) -> Array:
    """(B, 3, 4) affine maps from rest to the new shape.

    stretch, girth (B,): factors along and across each bone; turns (B, 3, 3): rotation of each bone about its
    head, inherited by its descendants. A bone's head follows its parent; scales are not inherited.
    """
    heads, axes = skeleton.heads, skeleton.tails - skeleton.heads
    axes = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-12)
    along = axes[:, :, None] * axes[:, None]
    form = girth[:, None, None] * (np.eye(3) - along) + stretch[:, None, None] * along
    turned, place = np.empty((skeleton.count, 3, 3)), np.empty((skeleton.count, 3))
    for bone, parent in enumerate(skeleton.parents):  # parents come first
        turned[bone], place[bone] = turns[bone], heads[bone]
        if parent >= 0:
            turned[bone] = turned[parent] @ turns[bone]
            place[bone] = place[parent] + turned[parent] @ form[parent] @ (heads[bone] - heads[parent])
    linear = turned @ form
    return np.concatenate([linear, (place - np.einsum("bij,bj->bi", linear, heads))[:, :, None]], axis=2)


def _moves(transforms: Array, points: Array) -> Array:
    """(V, B, 3): how far each transform moves each point."""
    return np.einsum("bij,vj->vbi", transforms[:, :, :3] - np.eye(3), points) + transforms[:, :, 3]
