# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from guidance images: signals, images, optimisation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..guidance import create_provider
from ..guidance.control import ControlSignal, make_signals
from ..guidance.provider import GuidanceContext, facts_of, to_bytes
from ..render.backends import choose_backend
from ..render.camera import Camera
from ..rig.skeleton import Skeleton
from ..skinning.fields import create_field
from ..skinning.geodesic import body_distances
from ..skinning.initial import initial_weights
from ..skinning.losses import LossWeights
from ..skinning.optimise import LearningOptions, Optimiser
from ..skinning.posers import Poser, SplatPoser
from ..skinning.presets import Preset, preset_by_name
from ..skinning.subset import SplatSubset
from ..skinning.views import Target
from .eta import Eta
from .live_pictures import LivePictures
from .optimise_loop import make_guidance, optimise, try_out
from .previews import weights_picture
from .proxy import Proxy
from .steps import JobInputs
from .work_kinds import rendering_kinds

TRIAL_POSES = 8
"""Poses of each view in a try-out. A view renders what it sees in any of them: with 6 the try-outs of `thorough` took
0.40 s, with 15 they took 0.60 s, the run itself 0.5 s an iteration."""

LIVE_SIZE = 256
"""Width and height of pictures of the weights while they are learned: icons in a panel."""

Pictures = Sequence[NDArray[Any]]
Masks = NDArray[np.bool_]
Weights = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Learned:
    """weights (M, B) of the nodes: the splats of the subset, or the proxy mesh's vertices; signals and targets: what
    they were learned from; report: numbers and words; query: see `WeightField.query`."""

    weights: Weights
    signals: Sequence[ControlSignal] = ()
    targets: Sequence[Target] = ()
    report: Mapping[str, Any] = field(default_factory=dict)
    query: Callable[[NDArray[Any]], Any] | None = None


def work_kinds(job: JobInputs, splats: int) -> dict[str, tuple[int, float]]:
    """The kinds of work of a job on `splats` splats that renders; see `Eta`."""
    chosen = job.settings
    return rendering_kinds(chosen, splats, job.skeleton.count)


@dataclass(frozen=True, eq=False)
class GuidedStage:
    """What learning needs besides the splats: settings, losses, rasteriser."""

    job: JobInputs
    eta: Eta
    preset: Preset
    losses: LossWeights
    rasterizer: str
    remark: str

    @classmethod
    def open(cls, job: JobInputs, eta: Eta) -> GuidedStage:
        """Choose the rasteriser. Raises InputError if it cannot be used."""
        preset, losses = preset_by_name(job.settings.preset), LossWeights.parse(job.settings.losses)
        rasterizer, remark = choose_backend(job.settings.rasterizer)
        eta.report("initial", remark or "Preparing the splats")
        return cls(job, eta, preset, losses, rasterizer, remark)

    def try_out_on_splats(
        self, subset: SplatSubset, skeleton: Skeleton, cameras: Sequence[Camera], images: Pictures, masks: Masks
    ) -> Poser:
        """Measure the cost of an iteration before anything else, with the paper's initial weights, which are quick to
        compute; returns the poser, for `learn`.

        images, masks (V, H, W): the subset at rest from each of the cameras.
        """
        rough = initial_weights("visibility", subset.cloud, skeleton, masks, cameras)
        poser = SplatPoser(subset.cloud, self.losses.arap_neighbours)
        return self._try_out(poser, rough, subset, skeleton, cameras, images)

    def try_out_on_proxy(
        self,
        subset: SplatSubset,
        proxy: Proxy,
        skeleton: Skeleton,
        cameras: Sequence[Camera],
        images: Pictures,
        masks: Masks,
    ) -> Poser:
        """As `try_out_on_splats`, with splats anchored to a mesh."""
        rough, _ = proxy.initial("visibility", subset.cloud, skeleton, masks, cameras, {})
        poser = proxy.poser(subset, self.losses.arap_neighbours)
        return self._try_out(poser, rough, subset, skeleton, cameras, images)

    def learn(
        self,
        subset: SplatSubset,
        skeleton: Skeleton,
        cameras: Sequence[Camera],
        poser: Poser,
        *,
        nodes: Weights,
        initial: Weights,
        confidence: NDArray[np.float32] | None,
        movable: NDArray[np.bool_] | None = None,
        on_splats: Callable[[Weights], Weights] = lambda weights: weights,
    ) -> Learned:
        """Weights of the nodes from the images of the job's guidance.

        cameras: the first of them, as many as the job's views, are those of the images; poser: from a try-out; nodes
        (M, B): its nodes' initial weights; initial (S, B): those of the subset's splats; confidence (M,) in the nodes'
        initial weights, or None; movable (M,): nodes that may change, all if left out; on_splats: from weights (M, B)
        of the nodes to those (S, B) of the subset's splats, to show them.
        """
        chosen, preset, eta = self.job.settings, self.preset, self.eta
        eta.report("guidance", "Distances through the body")
        walls = None if self.job.scope.walls is None else self.job.scope.walls[subset.index]
        distances = body_distances(subset.cloud, skeleton, walls=walls)
        eta.record("distances")
        weight_field = create_field(self._field_name(), poser.nodes, nodes, chosen.field_options)
        context = GuidanceContext(
            subset.cloud,
            skeleton,
            initial,
            distances,
            index=subset.index,
            whole=self.job.cloud.count,
            options=chosen.options,
            seed=chosen.seed,
            checkpoint=self.job.checkpoint,
            tick=lambda done, message: eta.report("guidance", message),
        )
        views = list(cameras[: chosen.views])
        signals = make_signals(skeleton, views, preset.poses_per_view, np.random.default_rng(chosen.seed))
        # Poses of their own, from their own seed: the others stay the same whatever is held out.
        unseen = make_signals(skeleton, views, preset.held_out, np.random.default_rng([chosen.seed, 1]))
        begin = partial(
            Optimiser,
            subset.cloud,
            skeleton,
            weight_field,
            poser=poser,
            options=LearningOptions(
                losses=self.losses,
                confidence=confidence,
                movable=movable,
                prune=preset.prune,
                seed=chosen.seed,
                rasterizer=self.rasterizer,
            ),
        )
        pictures = LivePictures(self.job.folder)
        provider = create_provider(chosen.guidance, context)
        targets = make_guidance(provider, [*signals, *unseen], eta, pictures)
        eta.end_stage("guidance")

        optimiser = begin(targets[: len(signals)], preset, held_out=targets[len(signals) :])
        small = cameras[0].resized(LIVE_SIZE)

        def watch() -> bool:
            return pictures.show(
                "weights", lambda: weights_picture(subset.cloud, on_splats(optimiser.weights()), small)
            )

        history, fitted = optimise(optimiser, eta, self.job.checkpoint, watch)
        eta.end_stage("optimise")
        report = {
            "field": self._field_name(),
            "guidance_images": len(signals),
            **facts_of(provider),
            "iterations": optimiser.iteration,
            "stopped": optimiser.stop.reason or "the schedule is done",
            "held_out": [{"iteration": at, "render": loss} for at, loss in optimiser.stop.history],
            "losses": history,
            **({"fit": fitted} if fitted else {}),
        }
        return Learned(optimiser.weights(), signals, targets, report, weight_field.query)

    def report(self, splats: int) -> dict[str, Any]:
        """The rasteriser and the number of splats that were learned on."""
        return {"rasterizer": {"name": self.rasterizer, "remark": self.remark}, "splats_optimised": splats}

    def _field_name(self) -> str:
        return self.job.settings.field_name(self.preset)

    def _try_out(
        self,
        poser: Poser,
        rough: Weights,
        subset: SplatSubset,
        skeleton: Skeleton,
        cameras: Sequence[Camera],
        images: Pictures,
    ) -> Poser:
        chosen, preset, eta = self.job.settings, self.preset, self.eta
        eta.report("prepare", "Trying out an iteration")
        # However a field finds its start, it is not tried out.
        options = {name: value for name, value in chosen.field_options.items() if name not in ("start", "fit_steps")}
        weight_field = create_field(self._field_name(), poser.nodes, rough, options)
        views = list(cameras[: chosen.views])
        signals = make_signals(skeleton, views, TRIAL_POSES, np.random.default_rng(chosen.seed))
        rest = [to_bytes(image) for image in images]
        at_rest = [Target(s.camera, s.transforms, rest[s.view]) for s in signals]
        trial = Optimiser(
            subset.cloud,
            skeleton,
            weight_field,
            at_rest,
            preset,
            poser=poser,
            options=LearningOptions(losses=self.losses, prune=preset.prune, rasterizer=self.rasterizer),
        )
        try_out(trial, eta, len(views) * preset.poses_per_view)
        eta.end_stage("prepare")
        return poser
