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

from ..guidance import NO_GUIDANCE
from ..guidance.provider import to_bytes
from ..job.progress import Progress
from ..job.settings import FRONTS, JobSettings
from ..render.backends import choose_backend
from ..render.camera import PAPER_AZIMUTHS, Camera, paper_views, percentile_bounds
from ..render.rasterizer import prepare, render_cloud, view_colors
from ..rig.lbs import sparsify
from ..rig.skeleton import Skeleton
from ..skinning import subset as subsets
from ..skinning.extent import unit_frame
from ..skinning.initial import initial_with_confidence
from ..skinning.losses import LossWeights
from ..skinning.presets import preset_by_name
from ..skinning.subset import choose_subset, follow_nearest
from ..skinning.views import SEEN
from ..splats.cleanup import Hygiene
from ..splats.cloud import SplatCloud
from .course import Course
from .guided_stage import Learned, learn, rehearse
from .optimise_loop import work
from .previews import preview_images
from .proxy import Proxy

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
    guided = chosen.guidance != NO_GUIDANCE
    kinds = work(preset, len(PAPER_AZIMUTHS), min(cloud.count, subsets.LIMIT), skeleton.count, guided)
    course = Course(progress, kinds)
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
    course.did("splats")

    rest_pictures = [render_cloud(subset.cloud, camera) for camera in cameras]
    masks = np.stack([alpha > 0.5 for _, alpha in rest_pictures])
    if guided:
        rest_images = [to_bytes(image) for image, _ in rest_pictures]
        poser = rehearse(
            chosen, subset, proxy, skeleton, masks, cameras, rest_images, losses, rasterizer, course
        )
    del rest_pictures
    course.say("initial", "Initial weights")
    given = (skeleton, masks, cameras, chosen.init_options)
    if proxy is None:
        initial_whole, sure = initial_with_confidence(chosen.init, whole, *given)
        nodes, trust = initial_whole[subset.index], None if sure is None else sure[subset.index]
    else:
        nodes, trust = proxy.initial(chosen.init, subset.cloud, *given)
        initial_whole = proxy.spread(nodes)
        sure = None if trust is None else proxy.spread(trust[:, None], normalised=False)[:, 0]
    course.did("initial")
    course.end_stage("initial")

    learned = Learned(nodes)
    if guided:
        initial = nodes if proxy is None else initial_whole[subset.index]
        learned = learn(
            chosen, subset, poser, skeleton, nodes, initial, trust, cameras, losses, rasterizer, course, checkpoint
        )

    course.say("finish", "Weights of all splats")
    mesh_weights = None
    if proxy is not None:
        weights, mesh_weights = proxy.spread(learned.weights), learned.weights
    elif guided:
        weights = subset.spread(learned.weights, nodes, initial_whole, learned.query)
    else:
        weights = initial_whole.copy()
    weights = follow_nearest(whole.means, weights, ignored)
    if chosen.max_influences:
        weights = sparsify(weights, chosen.max_influences)
        mesh_weights = None if mesh_weights is None else sparsify(mesh_weights, chosen.max_influences)
    previews = preview_images(whole, initial_whole, weights, cameras, learned.signals, learned.targets)
    changed = _change(weights, initial_whole)
    course.end_stage("finish")
    report = {
        "settings": chosen.as_dict(),
        "rasterizer": {"name": rasterizer, "remark": remark},
        "splats": whole.count,
        "splats_optimised": subset.cloud.count if guided else 0,
        "hygiene": {**bad_counts, **needle_counts},
        "bones": skeleton.count,
        "guidance_images": len(learned.signals),
        **learned.report,
        "seconds": course.seconds,
        "mean_weight_change": float(changed.mean()),
        "bones_without_splats": [
            name for name, most in zip(skeleton.names, weights.max(axis=0), strict=True) if most < 0.01
        ],
    }
    if sure is not None:
        # Where the images disagree with what was known, neither is sure.
        sure = np.clip(sure * (1 - changed), 0, 1).astype(np.float32) if guided else sure
        report["mean_confidence"] = float(sure.mean())
    if proxy is not None:
        report["mesh"] = proxy.summary()
    return Outcome(weights, report, previews, mesh_weights, sure)


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
        scene = prepare(cloud.scales, view_colors(cloud, camera), cloud.opacities, backend="cpu")
        seen |= scene.contribution(cloud.means, cloud.quats, camera) > SEEN
    return seen


def _change(weights: NDArray[np.float32], initial: NDArray[np.float32]) -> NDArray[np.float32]:
    """Half the L1 distance of the rows (N,), by parts: copies of large clouds' weights are large."""
    change = np.empty(len(weights), np.float32)
    for first in range(0, len(weights), 50_000):
        part = slice(first, first + 50_000)
        change[part] = np.abs(weights[part] - initial[part]).sum(axis=1) / 2
    return change
