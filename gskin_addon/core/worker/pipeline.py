# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole job on arrays: initial weights, guidance images, optimisation, previews."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..guidance import create_provider
from ..guidance.control import ControlSignal, make_signals
from ..guidance.provider import GuidanceContext
from ..render.camera import paper_views, percentile_bounds
from ..render.rasterizer import render_cloud
from ..rig.lbs import sparsify
from ..rig.skeleton import Skeleton
from ..skinning.extent import unit_frame
from ..skinning.fields import create_field
from ..skinning.geodesic import body_distances
from ..skinning.initial import initial_weights
from ..skinning.optimise import LossWeights, Optimiser, Target
from ..skinning.presets import preset_by_name
from ..skinning.subset import choose_subset, follow_nearest
from ..splats.cloud import SplatCloud
from ..splats.hygiene import Hygiene
from .previews import preview_images
from .progress import Progress
from .proxy import Proxy
from .settings import FRONTS, PRESET_FIELD, JobSettings

GUIDANCE_SIZE = 512
CHECKPOINT_SECONDS = 5.0
# The weight volume's state has 450 MB: writing it may take this part of the time.
CHECKPOINT_SHARE = 0.1
# Shares of the whole run, for the progress bar: measured at 50,000 splats and 20 bones.
INITIAL_END, GUIDANCE_END, OPTIMISE_END = 0.08, 0.2, 0.98


@dataclass(frozen=True)
class Outcome:
    """weights (N, B) float32, rows sum to 1; report: numbers and words; previews: images (H, W, 3) in [0, 1];
    mesh_weights (V, B): of the proxy mesh's vertices, where the job has one."""

    weights: NDArray[np.float32]
    report: dict[str, Any]
    previews: dict[str, NDArray[Any]]
    mesh_weights: NDArray[np.float32] | None = None


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
    field_name = preset.field if chosen.field == PRESET_FIELD else chosen.field
    clock = _Clock()
    progress("initial", 0.0, {}, "Preparing the splats")
    whole, skeleton = to_unit_size(cloud, skeleton)
    hygiene = Hygiene.parse(chosen.hygiene)
    ignored, bad_counts = hygiene.find(whole)
    shaped, needle_counts = hygiene.shape(whole)
    subset = choose_subset(shaped, chosen.seed, ignored=ignored)
    proxy = Proxy.load(checkpoint.parent / chosen.mesh, cloud) if chosen.mesh else None
    cameras = paper_views(*percentile_bounds(whole.means), GUIDANCE_SIZE, front=FRONTS[chosen.front])

    progress("initial", 0.01, {}, "Initial weights")
    masks = np.stack([render_cloud(subset.cloud, camera)[1] > 0.5 for camera in cameras])
    if proxy is None:
        nodes, initial_whole = None, initial_weights(chosen.init, whole, skeleton, masks, cameras)
    else:
        nodes = proxy.initial(chosen.init, subset.cloud, skeleton, masks, cameras)
        initial_whole = proxy.spread(nodes)
    initial = initial_whole[subset.index]
    progress("initial", 0.04, {}, "Distances through the body")
    distances = body_distances(subset.cloud, skeleton)
    clock.lap("initial")

    progress("guidance", INITIAL_END, {}, "Guidance images")
    context = GuidanceContext(
        subset.cloud, skeleton, initial, distances, index=subset.index, options=chosen.options
    )
    rng = np.random.default_rng(chosen.seed)
    signals = make_signals(skeleton, cameras, preset.poses_per_view, rng)
    targets = _make_guidance(create_provider(chosen.guidance, context), signals, progress)
    clock.lap("guidance")

    if proxy is None or nodes is None:
        poser, field = None, create_field(field_name, subset.cloud.means, initial, chosen.field_options)
    else:
        poser, field = proxy.poser(subset), create_field(field_name, proxy.verts, nodes, chosen.field_options)
    optimiser = Optimiser(
        subset.cloud, skeleton, field, targets, preset, poser=poser, losses=LossWeights(), seed=chosen.seed
    )
    losses = _optimise(optimiser, preset.iterations, progress, checkpoint)
    clock.lap("optimise")

    progress("finish", OPTIMISE_END, {}, "Weights of all splats")
    learned, mesh_weights = optimiser.weights(), None
    if proxy is None:
        weights = follow_nearest(whole.means, subset.spread(learned, initial, initial_whole), ignored)
    else:
        weights, mesh_weights = proxy.spread(learned), learned
    if chosen.max_influences:
        weights = sparsify(weights, chosen.max_influences)
        mesh_weights = None if mesh_weights is None else sparsify(mesh_weights, chosen.max_influences)
    previews = preview_images(whole, initial_whole, weights, cameras, signals, targets)
    clock.lap("finish")
    report = {
        "settings": chosen.as_dict(),
        "field": field_name,
        "splats": whole.count,
        "splats_optimised": subset.cloud.count,
        "hygiene": {**bad_counts, **needle_counts},
        "bones": skeleton.count,
        "guidance_images": len(targets),
        "iterations": optimiser.iteration,
        "losses": losses,
        "seconds": clock.laps,
        "mean_weight_change": float(np.abs(weights - initial_whole).sum(axis=1).mean() / 2),
        "bones_without_splats": [
            name for name, most in zip(skeleton.names, weights.max(axis=0), strict=True) if most < 0.01
        ],
    }
    if proxy is not None:
        report["mesh"] = proxy.summary()
    return Outcome(weights, report, previews, mesh_weights)


class _Clock:
    """Wall seconds by stage."""

    def __init__(self) -> None:
        self._last = time.monotonic()
        self.laps: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        now = time.monotonic()
        self.laps[stage] = round(now - self._last, 2)
        self._last = now


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


def _make_guidance(provider: Any, signals: Sequence[ControlSignal], progress: Progress) -> list[Target]:
    targets = []
    images = provider.images(signals)
    for number, signal in enumerate(signals):
        done = INITIAL_END + (GUIDANCE_END - INITIAL_END) * number / len(signals)
        progress("guidance", done, {}, f"Guidance image {number + 1} of {len(signals)}")
        targets.append(Target(signal.camera, signal.transforms, next(images)))
    return targets


def _optimise(
    optimiser: Optimiser, iterations: int, progress: Progress, checkpoint: Path
) -> list[dict[str, float]]:
    """Run to the end, from the checkpoint where there is one; the losses of about 50 iterations."""
    path = checkpoint / "optimiser.pt"
    history: list[dict[str, float]] = []
    if path.is_file():
        state = torch.load(path, weights_only=False)  # our own file, in the job's own folder
        optimiser.restore(state["optimiser"])
        history = state["history"]
    saved, cost = time.monotonic(), 0.0
    every = max(1, iterations // 50)
    while optimiser.iteration < iterations:
        number = optimiser.iteration
        parts = optimiser.step()
        if number % every == 0 or number == iterations - 1:
            history.append({"iteration": number, **parts})
        done = GUIDANCE_END + (OPTIMISE_END - GUIDANCE_END) * optimiser.iteration / iterations
        progress("optimise", done, parts, f"Iteration {number + 1} of {iterations}")
        begun = time.monotonic()
        if begun - saved > CHECKPOINT_SECONDS + cost / CHECKPOINT_SHARE:
            _save({"optimiser": optimiser.state(), "history": history}, path)
            saved = time.monotonic()
            cost = saved - begun
    return history


def _save(state: dict[str, Any], path: Path) -> None:
    temporary = path.with_suffix(".tmp")
    torch.save(state, temporary)
    os.replace(temporary, path)
