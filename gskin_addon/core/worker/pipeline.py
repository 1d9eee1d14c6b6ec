# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole job on arrays: initial weights, guidance images, optimisation, previews."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..guidance import create_provider
from ..guidance.control import make_signals
from ..guidance.provider import GuidanceContext, to_bytes
from ..render.backends import choose_backend
from ..render.camera import PAPER_AZIMUTHS, Camera, paper_views, percentile_bounds
from ..render.rasterizer import prepare, render_cloud, view_colors
from ..rig.lbs import sparsify
from ..rig.skeleton import Skeleton
from ..skinning import subset as subsets
from ..skinning.extent import unit_frame
from ..skinning.fields import create_field
from ..skinning.geodesic import body_distances
from ..skinning.initial import initial_weights
from ..skinning.losses import LossWeights
from ..skinning.optimise import Optimiser
from ..skinning.posers import Poser, SplatPoser
from ..skinning.presets import preset_by_name
from ..skinning.subset import choose_subset, follow_nearest
from ..skinning.views import SEEN, Target
from ..splats.cloud import SplatCloud
from ..splats.hygiene import Hygiene
from .course import Course
from .learning import make_guidance, optimise, try_out, work
from .previews import preview_images
from .progress import Progress
from .proxy import Proxy
from .settings import FRONTS, PRESET_FIELD, JobSettings

GUIDANCE_SIZE = 512


@dataclass(frozen=True)
class Outcome:
    """weights (N, B) float32, rows sum to 1; report: numbers and words; previews: images (H, W, 3) in [0, 1];
    mesh_weights (V, B): of the proxy mesh's vertices, where the job has one; confidence (N,) in 0..1, where the
    initial weights know how sure they are."""

    weights: NDArray[np.float32]
    report: dict[str, Any]
    previews: dict[str, NDArray[Any]]
    mesh_weights: NDArray[np.float32] | None = None
    confidence: NDArray[np.float32] | None = None


def run(
    cloud: SplatCloud,
    skeleton: Skeleton,
    settings: Mapping[str, Any],
    progress: Progress,
    checkpoint: Path,
) -> Outcome:
    """Skin `cloud` to `skeleton` (same world space, any unit).

    `checkpoint` is a folder, inside the job's, in which the optimiser leaves its state every few seconds; a run
    that finds one goes on from there and ends with the same weights as a run that was never stopped.

    Raises:
        InputError: settings that do not exist or do not fit. Cancelled: `progress` said so.
    """
    chosen = JobSettings.parse(settings)
    preset = preset_by_name(chosen.preset)
    losses = LossWeights.parse(chosen.losses)
    field_name = preset.field if chosen.field == PRESET_FIELD else chosen.field
    views = len(PAPER_AZIMUTHS)
    course = Course(progress, work(preset, views, min(cloud.count, subsets.LIMIT), skeleton.count))
    rasterizer, remark = choose_backend(chosen.rasterizer)
    course.say("initial", remark or "Preparing the splats")
    whole, skeleton = to_unit_size(cloud, skeleton)
    hygiene = Hygiene.parse(chosen.hygiene)
    ignored, bad_counts = hygiene.find(whole)
    shaped, needle_counts = hygiene.shape(whole)
    cameras = paper_views(*percentile_bounds(whole.means), GUIDANCE_SIZE, front=FRONTS[chosen.front])
    subset = choose_subset(shaped, chosen.seed, ignored=ignored, seen=partial(_seen_at_rest, shaped, cameras))
    del shaped
    proxy = Proxy.load(checkpoint.parent / chosen.mesh, cloud) if chosen.mesh else None
    course.did("initial")

    course.say("initial", "Initial weights")
    rest_pictures = [render_cloud(subset.cloud, camera) for camera in cameras]
    masks = np.stack([alpha > 0.5 for _, alpha in rest_pictures])
    if proxy is None:
        nodes, initial_whole = None, initial_weights(
            chosen.init, whole, skeleton, masks, cameras, chosen.init_options
        )
    else:
        nodes = proxy.initial(
            chosen.init, subset.cloud, skeleton, masks, cameras, chosen.init_options
        )
        initial_whole = proxy.spread(nodes)
    initial = initial_whole[subset.index]
    course.did("initial")
    course.say("initial", "Distances through the body")
    distances = body_distances(subset.cloud, skeleton)
    course.did("initial")
    course.end_stage("initial")

    course.say("guidance", "Guidance images")
    if proxy is None or nodes is None:
        poser: Poser = SplatPoser(subset.cloud, losses.arap_neighbours)
        field = create_field(field_name, subset.cloud.means, initial, chosen.field_options)
    else:
        poser = proxy.poser(subset, losses.arap_neighbours)
        field = create_field(field_name, proxy.verts, nodes, chosen.field_options)
    context = GuidanceContext(
        subset.cloud,
        skeleton,
        initial,
        distances,
        index=subset.index,
        options=chosen.options,
        seed=chosen.seed,
        checkpoint=checkpoint,
        tick=lambda done, message: course.say("guidance", message),
    )
    rng = np.random.default_rng(chosen.seed)
    signals = make_signals(skeleton, cameras, preset.poses_per_view, rng)
    # Poses of their own, from their own seed: the others stay the same whatever is held out.
    unseen = make_signals(skeleton, cameras, preset.held_out, np.random.default_rng([chosen.seed, 1]))
    begin = partial(
        Optimiser,
        subset.cloud,
        skeleton,
        field,
        poser=poser,
        losses=losses,
        seed=chosen.seed,
        rasterizer=rasterizer,
    )
    at_rest = [
        Target(s.camera, s.transforms, to_bytes(rest_pictures[s.view][0])) for s in signals[:: preset.poses_per_view]
    ]
    try_out(begin(at_rest, preset), course)
    course.end_stage("prepare")
    targets = make_guidance(create_provider(chosen.guidance, context), [*signals, *unseen], course)
    del context, distances, rest_pictures
    course.end_stage("guidance")

    optimiser = begin(targets[: len(signals)], preset, held_out=targets[len(signals) :])
    history = optimise(optimiser, course, checkpoint)
    course.end_stage("optimise")

    course.say("finish", "Weights of all splats")
    learned, mesh_weights = optimiser.weights(), None
    if proxy is None:
        spread = subset.spread(learned, initial, initial_whole, field.query)
        weights = follow_nearest(whole.means, spread, ignored)
    else:
        weights, mesh_weights = proxy.spread(learned), learned
    if chosen.max_influences:
        weights = sparsify(weights, chosen.max_influences)
        mesh_weights = None if mesh_weights is None else sparsify(mesh_weights, chosen.max_influences)
    previews = preview_images(whole, initial_whole, weights, cameras, signals, targets)
    course.end_stage("finish")
    report = {
        "settings": chosen.as_dict(),
        "field": field_name,
        "rasterizer": {"name": rasterizer, "remark": remark},
        "splats": whole.count,
        "splats_optimised": subset.cloud.count,
        "hygiene": {**bad_counts, **needle_counts},
        "bones": skeleton.count,
        "guidance_images": len(signals),
        "iterations": optimiser.iteration,
        "stopped": optimiser.stop.reason or "the schedule is done",
        "held_out": [{"iteration": at, "render": loss} for at, loss in optimiser.stop.history],
        "losses": history,
        "seconds": course.seconds,
        "mean_weight_change": _mean_change(weights, initial_whole),
        "bones_without_splats": [
            name for name, most in zip(skeleton.names, weights.max(axis=0), strict=True) if most < 0.01
        ],
    }
    if proxy is not None:
        report["mesh"] = proxy.summary()
    return Outcome(weights, report, previews, mesh_weights)


def to_unit_size(cloud: SplatCloud, skeleton: Skeleton) -> tuple[SplatCloud, Skeleton]:
    """Both moved and scaled so that the object's bounding box has the diagonal 1 and its centre at 0."""
    centre, diagonal = unit_frame(cloud.means)
    moved = replace(
        cloud,
        means=((cloud.means - centre) / diagonal).astype(np.float32),
        scales=(cloud.scales / diagonal).astype(np.float32),
        stored={},
    )
    return moved, skeleton.moved(np.eye(3), 1.0 / diagonal, -centre / diagonal)


def _seen_at_rest(cloud: SplatCloud, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """Splats (N,) that show in some view."""
    seen = np.zeros(cloud.count, bool)
    for camera in cameras:
        scene = prepare(cloud.scales, view_colors(cloud, camera), cloud.opacities)
        seen |= scene.contribution(cloud.means, cloud.quats, camera) > SEEN
    return seen


def _mean_change(weights: NDArray[np.float32], initial: NDArray[np.float32]) -> float:
    """Half the mean L1 distance of the rows, by parts: copies of large clouds' weights are large."""
    total = 0.0
    for first in range(0, len(weights), 50_000):
        part = slice(first, first + 50_000)
        total += float(np.abs(weights[part] - initial[part]).sum(dtype=np.float64))
    return total / 2 / max(len(weights), 1)
