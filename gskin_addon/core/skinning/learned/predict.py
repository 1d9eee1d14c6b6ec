# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights of any splats and any skeleton by the trained network."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...rig.skeleton import Skeleton
from ...splats.cloud import SplatCloud
from .describe import Body, look_at
from .features import PRIOR
from .held_objects import hold
from .model_file import SHIPPED, load_model
from .parts import apart

if TYPE_CHECKING:
    from .network import PriorNetwork

Array = NDArray[Any]

NODES = 6000
"""Splats that the network sees; the others follow those around them."""

CAUTION = 0.3
"""Share of the heat weights in the logits: on families left out it lowers the errors of bodies unlike any that
the network has seen, and leaves the others as they are."""

SPREAD = 6
_CHUNK = 200_000


def learned_weights(cloud: SplatCloud, skeleton: Skeleton, model: Path | None = None) -> tuple[Array, Array]:
    """Weights (N, B) float32, rows sum to 1, and confidence (N,) float32 in [0, 1].

    The confidence is one minus the share of a splat's weight that the network expects to give to wrong bones.
    model: a file made by `gskin train-prior`; None for the one that comes with the add-on.

    Raises:
        InputError: fewer than two splats, or the model cannot be used.
    """
    networks = _loaded(model or SHIPPED)
    body = look_at(cloud, skeleton, limit=NODES)
    weights, confidence = predict_nodes(networks, body, skeleton.count)
    return spread(cloud, body, hold(weights, body.points, skeleton, body.size), confidence)


def heat_weights(cloud: SplatCloud, skeleton: Skeleton) -> Array:
    """Weights (N, B) float32, rows sum to 1, of bone heat on the splats: where the network starts from.

    After Baran & Popovic 2007, with `facing_distances` as Blender has them.

    Raises:
        InputError: fewer than two splats.
    """
    body = look_at(cloud, skeleton, limit=NODES, rows=8)
    return spread(cloud, body, body.reach.heat, np.ones(len(body.index), np.float32))[0]


@lru_cache(maxsize=2)
def _loaded(path: Path) -> tuple[PriorNetwork, ...]:
    return load_model(path)


def predict_nodes(networks: Sequence[PriorNetwork], body: Body, bones: int) -> tuple[Array, Array]:
    """Weights (M, B) and confidence (M,) of a body all of whose splats are described; the mean of the networks."""
    import torch

    from .network import make_batch

    described = body.description
    near, wide = body.parts.near
    arrays = {**vars(described), "near": near, "wide": wide, "labels": body.parts.labels}
    with torch.no_grad():
        batch = make_batch([arrays])
        answers = [network(batch) for network in networks]
        final = torch.stack([answer.final for answer in answers]).mean(0)
        heat = torch.from_numpy(described.values[..., PRIOR]) * (batch.bone >= 0)
        share = ((1 - CAUTION) * final + CAUTION * heat).softmax(-1).numpy()
        doubt = torch.stack([torch.sigmoid(answer.doubt) for answer in answers]).mean(0).numpy()
    weights = np.zeros((len(share), bones), np.float32)
    row, token = np.nonzero(described.bone >= 0)
    weights[row, described.bone[row, token]] = share[row, token]
    return weights / weights.sum(axis=1, keepdims=True), 1 - doubt


def spread(cloud: SplatCloud, body: Body, weights: Array, confidence: Array) -> tuple[Array, Array]:
    """From the nodes to all splats: means over the nearest nodes, of like colour and on this side of any gap."""
    from scipy.spatial import cKDTree

    if len(body.index) == cloud.count:
        return weights, confidence
    tree = cKDTree(body.points)
    k = min(SPREAD, len(body.index))
    colors = cloud.base_colors()
    out, sure = np.empty((cloud.count, weights.shape[1]), np.float32), np.empty(cloud.count, np.float32)
    for first in range(0, cloud.count, _CHUNK):
        rows = slice(first, min(first + _CHUNK, cloud.count))
        way, near = tree.query(cloud.means[rows], k)
        way, near = way.reshape(-1, k), near.reshape(-1, k).astype(np.int32)
        between = np.linalg.norm(body.points[near] - body.points[near[:, :1]], axis=-1)
        far = apart(near, between, body.reach.distances, rows=near[:, 0])
        reach = way[:, -1:] * 1.001 + 1e-12
        share = (1 - way / reach) ** 2 + 1e-6
        unlike = np.square(body.colors[near] - colors[rows][:, None]).sum(-1)
        share = np.where(far, 0, share * np.exp(-unlike / (2 * 0.1**2)) + 1e-9).astype(np.float32)
        share /= share.sum(axis=1, keepdims=True)
        block = np.zeros((len(near), weights.shape[1]), np.float32)
        for column in range(k):
            block += share[:, column : column + 1] * weights[near[:, column]]
        out[rows] = block
        sure[rows] = (share * confidence[near]).sum(axis=1)
    return out / out.sum(axis=1, keepdims=True), sure
