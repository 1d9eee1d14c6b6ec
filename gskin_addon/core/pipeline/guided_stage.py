# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from guidance images: signals, images, optimisation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..guidance import create_provider
from ..guidance.control import ControlSignal, make_signals
from ..guidance.provider import GuidanceContext
from ..job.settings import PRESET_FIELD, JobSettings
from ..render.camera import Camera
from ..rig.skeleton import Skeleton
from ..skinning.fields import create_field
from ..skinning.geodesic import body_distances
from ..skinning.initial import initial_weights
from ..skinning.losses import LossWeights
from ..skinning.optimise import Optimiser
from ..skinning.posers import Poser, SplatPoser
from ..skinning.presets import preset_by_name
from ..skinning.subset import SplatSubset
from ..skinning.views import Target
from .course import Course
from .optimise_loop import make_guidance, optimise, try_out
from .proxy import Proxy

TRIAL_POSES = 8
"""Poses of each view in a try-out. A view renders what it sees in any of them: with 6 the try-outs of `paper` took
0.40 s, with 15 they took 0.60 s, the run itself 0.5 s an iteration."""


@dataclass(frozen=True)
class Learned:
    """weights (M, B) of the nodes: the splats of the subset, or the proxy mesh's vertices; signals and targets: what
    they were learned from; report: numbers and words; query: see `WeightField.query`."""

    weights: NDArray[np.float32]
    signals: Sequence[ControlSignal] = ()
    targets: Sequence[Target] = ()
    report: Mapping[str, Any] = field(default_factory=dict)
    query: Callable[[NDArray[Any]], Any] | None = None


def rehearse(
    chosen: JobSettings,
    subset: SplatSubset,
    proxy: Proxy | None,
    skeleton: Skeleton,
    masks: NDArray[np.bool_],
    cameras: Sequence[Camera],
    rest_images: Sequence[NDArray[np.uint8]],
    losses: LossWeights,
    rasterizer: str,
    course: Course,
) -> Poser:
    """Find out at the very start what an iteration costs, with the paper's initial weights, which take no time;
    returns the poser, for `learn`.

    masks and rest_images: the subset from each of the cameras.
    """
    preset = preset_by_name(chosen.preset)
    course.say("prepare", "Trying out an iteration")
    rough: NDArray[np.float32]
    if proxy is None:
        poser: Poser = SplatPoser(subset.cloud, losses.arap_neighbours)
        rough = initial_weights("visibility", subset.cloud, skeleton, masks, cameras)
    else:
        poser = proxy.poser(subset, losses.arap_neighbours)
        rough, _ = proxy.initial("visibility", subset.cloud, skeleton, masks, cameras, {})
    weight_field = create_field(_field_name(chosen), poser.nodes, rough, chosen.field_options)
    signals = make_signals(skeleton, list(cameras), TRIAL_POSES, np.random.default_rng(chosen.seed))
    at_rest = [Target(s.camera, s.transforms, rest_images[s.view]) for s in signals]
    trial = Optimiser(
        subset.cloud, skeleton, weight_field, at_rest, preset, poser=poser, losses=losses, rasterizer=rasterizer
    )
    try_out(trial, course, len(cameras) * preset.poses_per_view)
    course.end_stage("prepare")
    return poser


def _field_name(chosen: JobSettings) -> str:
    return preset_by_name(chosen.preset).field if chosen.field == PRESET_FIELD else chosen.field


def learn(
    chosen: JobSettings,
    subset: SplatSubset,
    poser: Poser,
    skeleton: Skeleton,
    nodes: NDArray[np.float32],
    initial: NDArray[np.float32],
    trust: NDArray[np.float32] | None,
    cameras: Sequence[Camera],
    losses: LossWeights,
    rasterizer: str,
    course: Course,
    checkpoint: Path,
) -> Learned:
    """Weights of the nodes from the images of the job's guidance.

    poser: from `rehearse`; nodes (M, B): its nodes' initial weights; initial (S, B): those of the subset's splats;
    trust (M,): confidence in the nodes' initial weights, or None.
    """
    preset = preset_by_name(chosen.preset)
    course.say("guidance", "Distances through the body")
    distances = body_distances(subset.cloud, skeleton)
    course.did("distances")
    field_name = _field_name(chosen)
    weight_field = create_field(field_name, poser.nodes, nodes, chosen.field_options)
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
    signals = make_signals(skeleton, list(cameras), preset.poses_per_view, np.random.default_rng(chosen.seed))
    # Poses of their own, from their own seed: the others stay the same whatever is held out.
    unseen = make_signals(skeleton, list(cameras), preset.held_out, np.random.default_rng([chosen.seed, 1]))
    begin = partial(
        Optimiser,
        subset.cloud,
        skeleton,
        weight_field,
        poser=poser,
        losses=losses,
        confidence=trust,
        seed=chosen.seed,
        rasterizer=rasterizer,
    )
    targets = make_guidance(create_provider(chosen.guidance, context), [*signals, *unseen], course)
    course.end_stage("guidance")

    optimiser = begin(targets[: len(signals)], preset, held_out=targets[len(signals) :])
    history = optimise(optimiser, course, checkpoint)
    course.end_stage("optimise")
    report = {
        "field": field_name,
        "iterations": optimiser.iteration,
        "stopped": optimiser.stop.reason or "the schedule is done",
        "held_out": [{"iteration": at, "render": loss} for at, loss in optimiser.stop.history],
        "losses": history,
    }
    return Learned(optimiser.weights(), signals, targets, report, weight_field.query)
