# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights of any splats and any skeleton by the trained network."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.influences import Influences
from ...rig.nearest_points import nearest_points
from ...rig.skeleton import Skeleton
from ...splats.cloud import SplatCloud
from ...ticks import Tick, silent, stretch
from ..walls import blocked, nearest_open
from .describe import Body, describe_body
from .features import PRIOR
from .held_objects import hold
from .model_file import SHIPPED, load_model
from .network import PriorNetwork, softmax
from .parts import apart

Array = NDArray[Any]

NODES = 6000
"""Splats that the network sees; the others follow those around them."""

CAUTION = 0.3
"""Share of the heat weights in the logits: on families left out it lowers the errors of bodies unlike any that
the network has seen, and leaves the others as they are."""

NEAREST_NODES = 6
_CHUNK = 25_000


def learned_weights(
    cloud: SplatCloud,
    skeleton: Skeleton,
    model: Path | None = None,
    *,
    walls: Array | None = None,
    tick: Tick = silent,
) -> tuple[Array, Array]:
    """Weights (N, B) float32, rows sum to 1, and confidence (N,) float32 in [0, 1].

    The confidence is one minus the share of a splat's weight that the network expects to give to wrong bones.
    model: a file made by `gskin train-prior`; None for the one that comes with the add-on. walls (N,): labels of the
    splats, 0 for none; nothing spreads straight from one label to another, see `walls`.

    Raises:
        InputError: fewer than two splats, or the model cannot be used.
    """
    return _learned(cloud, skeleton, model, walls, tick, heat=False)[:2]


def learned_weights_and_heat(
    cloud: SplatCloud,
    skeleton: Skeleton,
    model: Path | None = None,
    *,
    walls: Array | None = None,
    tick: Tick = silent,
) -> tuple[Array, Array, Influences]:
    """As `learned_weights`, with the bone heat from which the network started: the strongest bones of `heat_weights`.

    The network looks at heat anyway, so that this costs little more.
    """
    weights, confidence, heat = _learned(cloud, skeleton, model, walls, tick, heat=True)
    assert heat is not None
    return weights, confidence, heat


def _learned(
    cloud: SplatCloud, skeleton: Skeleton, model: Path | None, walls: Array | None, tick: Tick, *, heat: bool
) -> tuple[Array, Array, Influences | None]:
    networks = _loaded(model or SHIPPED)
    nodes = _nodes_share(cloud.count)
    body = describe_body(cloud, skeleton, limit=NODES, walls=walls, tick=stretch(tick, 0.0, 0.6 * nodes))
    weights, confidence = predict_nodes(networks, body, skeleton.count, tick=stretch(tick, 0.6 * nodes, nodes))
    held = hold(weights, body.points, skeleton, body.size)
    return interpolate_to_splats(
        cloud, body, held, confidence, walls=walls, tick=stretch(tick, nodes, 1.0),
        start=body.reach.heat if heat else None,
    )  # fmt: skip


def heat_weights(
    cloud: SplatCloud, skeleton: Skeleton, *, walls: Array | None = None, tick: Tick = silent
) -> Array:
    """Weights (N, B) float32, rows sum to 1, of bone heat on the splats: where the network starts from.

    After Baran & Popovic 2007, with `normal_weighted_distances` as Blender has them. walls as in `learned_weights`.

    Raises:
        InputError: fewer than two splats.
    """
    nodes = _nodes_share(cloud.count)
    body = describe_body(cloud, skeleton, limit=NODES, rows=8, walls=walls, tick=stretch(tick, 0.0, nodes))
    certain = np.ones(len(body.index), np.float32)
    return interpolate_to_splats(cloud, body, body.reach.heat, certain, walls=walls, tick=stretch(tick, nodes, 1.0))[0]


def _nodes_share(count: int) -> float:
    """Share of the work that is done for the nodes alone: as much as interpolating to 700,000 splats is."""
    return 1 - count / (count + 700_000)


@lru_cache(maxsize=2)
def _loaded(path: Path) -> tuple[PriorNetwork, ...]:
    return load_model(path)


def predict_nodes(
    networks: Sequence[PriorNetwork], body: Body, bones: int, *, tick: Tick = silent
) -> tuple[Array, Array]:
    """Weights (M, B) and confidence (M,) of a body all of whose splats are described; the mean of the networks."""
    described = body.description
    final, doubt = np.zeros(described.bone.shape, np.float32), np.zeros(len(described.bone), np.float32)
    for number, network in enumerate(networks):
        part = stretch(tick, number / len(networks), (number + 1) / len(networks))
        answer = network(described, body.parts, part)
        final += answer.final
        doubt += 1 / (1 + np.exp(-answer.doubt))
    heat = described.values[..., PRIOR] * (described.bone >= 0)
    share = softmax((1 - CAUTION) / len(networks) * final + CAUTION * heat)
    weights = np.zeros((len(share), bones), np.float32)
    row, token = np.nonzero(described.bone >= 0)
    weights[row, described.bone[row, token]] = share[row, token]
    return weights / weights.sum(axis=1, keepdims=True), np.asarray(1 - doubt / len(networks), np.float32)


def interpolate_to_splats(
    cloud: SplatCloud,
    body: Body,
    weights: Array,
    confidence: Array,
    *,
    walls: Array | None = None,
    tick: Tick = silent,
    start: Array | None = None,
) -> tuple[Array, Array, Influences | None]:
    """From the nodes to all splats: means over the nearest nodes, of like colour and on this side of gaps and walls.

    start (M, B): further weights of the nodes; of these each splat gets its strongest bones only, as the third value.
    """
    if len(body.index) == cloud.count:
        return weights, confidence, None if start is None else Influences.strongest(start)
    colors = cloud.base_colors()
    pitch = float(np.median(nearest_points(body.points, body.points, min(NEAREST_NODES, len(body.index)))[0]))
    out, out_confidence = np.empty((cloud.count, weights.shape[1]), np.float32), np.empty(cloud.count, np.float32)
    parts: list[Influences] = []
    for first in range(0, cloud.count, _CHUNK):
        rows = slice(first, min(first + _CHUNK, cloud.count))
        own = None if walls is None else np.asarray(walls)[rows]
        share, near = _shares(body, cloud.means[rows], colors[rows], pitch, own)
        out[rows] = _mean(share, near, weights)
        if start is not None:
            parts.append(Influences.strongest(_mean(share, near, start)))
        out_confidence[rows] = (share * confidence[near]).sum(axis=1)
        tick(rows.stop / cloud.count)
    return out, out_confidence, Influences.joined(parts) if parts else None


def _mean(share: Array, near: Array, weights: Array) -> Array:
    """Weights (n, B) of splats from those of their nodes; share, near (n, NEAREST_NODES)."""
    block = np.zeros((len(near), weights.shape[1]), np.float32)
    for column in range(near.shape[1]):
        block += share[:, column : column + 1] * weights[near[:, column]]
    return block / block.sum(axis=1, keepdims=True)


def _shares(
    body: Body, points: Array, colors: Array, pitch: float, walls: Array | None
) -> tuple[Array, Array]:
    """Shares and indices (n, NEAREST_NODES) of the nodes that splats follow; pitch: the usual way between
    neighbouring nodes; walls (n,): labels of the splats."""
    way, near = nearest_points(body.points, points, min(NEAREST_NODES, len(body.index)))
    beyond = np.zeros(near.shape, bool)
    if walls is not None and body.walls is not None:
        beyond = blocked(walls[:, None], body.walls[near])
        lost = np.flatnonzero(beyond[:, 0])
        # The nearest node of the splat's own side leads, whatever lies nearer.
        way[lost, 0], near[lost, 0] = nearest_open(body.points, points[lost], body.walls, walls[lost])
        beyond[:, 0] = False
    between = np.linalg.norm(body.points[near] - body.points[near[:, :1]], axis=-1)
    far = apart(near, between, body.reach.distances, rows=near[:, 0], pitch=pitch, walls=body.walls) | beyond
    reach = np.where(beyond, 0, way).max(axis=1, keepdims=True) * 1.001 + 1e-12
    share = (1 - np.minimum(way / reach, 1)) ** 2 + 1e-6
    unlike = np.square(body.colors[near] - colors[:, None]).sum(-1)
    share = np.where(far, 0, share * np.exp(-unlike / (2 * 0.1**2)) + 1e-9)
    share[beyond] = 0
    share = share.astype(np.float32)
    return share / share.sum(axis=1, keepdims=True), near
