# SPDX-License-Identifier: GPL-3.0-or-later
"""A made-up limb with known weights: a striped, bent tube of splats on a chain of bones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from proxy_meshes import tube

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.from_mesh import sample_mesh


@dataclass(frozen=True)
class Limb:
    cloud: SplatCloud
    skeleton: Skeleton
    weights: NDArray[np.float32]


def make_limb(count: int = 1500, bones: int = 3, seed: int = 0) -> Limb:
    """A tube along x, 0.24 thick and `bones` long, colour stripes along and around it.

    True weights: rigid in the middle of each bone, a linear blend over the 0.3 around each joint.
    """
    verts, faces = tube(bones, 12 * bones + 1, 16)
    corner = verts[faces]
    rgb = 0.5 + 0.4 * np.stack(
        [np.sin(9 * corner[..., 0]), np.cos(7 * corner[..., 0]), np.sign(corner[..., 1])], axis=-1
    )
    cloud, _, _ = sample_mesh(verts, faces, rgb, count, np.random.default_rng(seed), below=0.0)
    heads = np.array([[k, 0, 0] for k in range(bones)], float)
    skeleton = Skeleton(
        tuple(f"bone{k}" for k in range(bones)), np.arange(bones) - 1, heads, heads + (1.0, 0, 0)
    )
    knots = np.concatenate([[-9.0], np.repeat(np.arange(1, bones), 2) + np.tile([-0.15, 0.15], bones - 1), [99.0]])
    at = cloud.means[:, 0]
    weights = np.stack(
        [np.interp(at, knots, np.eye(bones)[np.repeat(np.arange(bones), 2)][:, k]) for k in range(bones)], axis=1
    )
    return Limb(cloud, skeleton, weights.astype(np.float32))
