# SPDX-License-Identifier: GPL-3.0-or-later
"""Learning the weights from guidance images (Eq. 9): rendering loss + ARAP + coupling, by Adam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..render.backends import AUTO, resolve_backend
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from .arap import arap_loss
from .coupling import coupling_loss, prepare_coupling
from .device_renderer import DeviceRenderer, tensor_device
from .fields.base import WeightField
from .losses import LossWeights
from .posers import Poser, SplatPoser
from .presets import Preset
from .prior_loss import PriorLoss
from .stopping import EarlyStop
from .views import GuidanceViews, Target
from .visibility_schedule import PRUNE_FROM, visibility_schedule

__all__ = ["LossWeights", "Optimiser", "Target"]


@dataclass(frozen=True, eq=False)
class LearningOptions:
    """How an `Optimiser` learns, beside its preset.

    losses: weights of the loss terms; confidence (M,), 0 to 1, weights the prior loss of each node (default: 1);
    movable (M,) marks the nodes that may change, all if left out: the others keep the field's initial weights and are
    only rendered; prune: False renders all splats in every view, the hidden ones too; seed: of all randomness;
    background: sRGB; rasterizer: a name in BACKENDS, or "auto".
    """

    losses: LossWeights = field(default_factory=LossWeights)
    confidence: NDArray[Any] | None = None
    movable: NDArray[np.bool_] | None = None
    prune: bool = True
    seed: int = 0
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rasterizer: str = AUTO


DEFAULT_OPTIONS = LearningOptions()


class Optimiser:
    """Adam on a weight field; its state can be saved and restored.

    `poser` says how weights move the splats (default: each splat by its own weights); the field gives the weights of
    the poser's nodes. The cloud, the skeleton and the targets must share one coordinate system in which the object is
    about unit size (bounding-box diagonal 1), so that the loss weights mean the same for every asset.

    `held_out` targets are used by `check` only.
    """

    def __init__(
        self,
        cloud: SplatCloud,
        skeleton: Skeleton,
        field: WeightField,
        targets: Sequence[Target],
        preset: Preset,
        *,
        poser: Poser | None = None,
        held_out: Sequence[Target] = (),
        options: LearningOptions = DEFAULT_OPTIONS,
    ) -> None:
        losses, background = options.losses, options.background
        self.field, self.targets, self.preset, self.losses = field, targets, preset, losses
        self.iteration = 0
        self.stop = EarlyStop(preset.patience)
        self._visible_since = -1
        self.rasterizer = resolve_backend(options.rasterizer)
        views = partial(
            GuidanceViews, cloud, dssim=losses.dssim, background=background, backend=self.rasterizer
        )
        self._views, self._held_out = views(targets), views(held_out)
        self._best: dict[str, torch.Tensor] | None = None
        self._rng = np.random.default_rng(options.seed)
        self._queue: list[int] = []
        self._rate = preset.learning_rate * field.rate
        self._adam = torch.optim.Adam(field.parameters(), lr=self._rate, betas=(0.9, 0.99), fused=True)
        self._poser: Poser = poser or SplatPoser(cloud, losses.arap_neighbours)
        self._device_renderer = self._make_device_renderer(cloud, background)
        # A GPU gains less from fewer splats than finding the visible ones costs.
        prune = options.prune and cloud.count >= PRUNE_FROM and self._device_renderer is None
        self.visibility_updates: frozenset[int] = visibility_schedule(preset, len(targets)) if prune else frozenset()
        nodes, self._neighbours = self._poser.nodes, self._poser.neighbours
        self._nodes = nodes
        self._prior_loss = PriorLoss(field, options.confidence)
        movable = options.movable
        self._movable = None if movable is None else torch.from_numpy(movable)[:, None]
        self._coupling = prepare_coupling(nodes, skeleton, neighbours=losses.coupling_neighbours)
        step = max(1, len(nodes) // 5000)
        edges = nodes[self._neighbours[::step]] - nodes[::step, None]
        self._edge_square = float(np.square(edges).sum(-1).mean()) + 1e-12

    def step(self) -> dict[str, float]:
        """One iteration on the next batch; returns the parts of the loss."""
        size = self.size_now()
        if self.must_update_visible:
            self.update_visible()
        for group in self._adam.param_groups:
            group["lr"] = self._rate * self._decay()
        batch = [self._next_target() for _ in range(min(self.preset.batch, len(self.targets)))]
        parts = self._descend(batch, size)
        self._adam.step()
        self.iteration += 1
        return parts

    def weights(self) -> NDArray[np.float32]:
        """The current weights of the poser's nodes (M, B), rows sum to 1."""
        with torch.no_grad():
            return self._weights().numpy()

    def check(self) -> float | None:
        """Mean photometric loss of the held-out targets, all splats rendered; keeps the best weights so far.

        None if nothing is held out. Afterwards `stop.reason` says whether to stop, and why.
        """
        if not self._held_out.targets:
            return None
        size = self.preset.stages[-1][0]
        with torch.no_grad():
            weights = self._weights()
            losses = []
            for index, target in enumerate(self._held_out.targets):
                means, quats = self._posed(weights, target.transforms[None])
                losses.append(self._held_out.loss(means[0], quats[0], index, size))
        value = float(np.mean(losses))
        last_stage = self.iteration > self.preset.iterations - self.preset.stages[-1][1]
        if self.stop.add(self.iteration, value, counts=last_stage):
            self._best = {name: part.detach().clone() for name, part in self.field.state_dict().items()}
        return value

    def use_best(self) -> None:
        """Return to the weights with the lowest held-out loss, if `check` was used."""
        if self._best is not None:
            self.field.load_state_dict(self._best)

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs to continue exactly from here."""
        return {
            "iteration": self.iteration,
            "queue": list(self._queue),
            "rng": self._rng.bit_generator.state,
            "field": self.field.state_dict(),
            "adam": self._adam.state_dict(),
            "looked": self._visible_since,
            "seen": [None if mask is None else mask.copy() for mask in self._views.visible],
            "stop": self.stop.state(),
            "best": self._best,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the `state` of an optimiser with the same inputs."""
        self.iteration = int(state["iteration"])
        self.field.load_state_dict(state["field"])
        self._adam.load_state_dict(state["adam"])
        self._rng.bit_generator.state = state["rng"]
        self._queue = list(state["queue"])
        self._visible_since = int(state["looked"])
        self._views.set_visible(state["seen"])
        self.stop.restore(state["stop"])
        self._best = state["best"]

    def size_now(self) -> int:
        """Image size of the next iteration, in pixels."""
        for size, stage in self.preset.ranges():
            if self.iteration in stage:
                return size
        return self.preset.stages[-1][0]

    @property
    def must_update_visible(self) -> bool:
        """Whether the next iteration begins with `update_visible`."""
        return self.iteration in self.visibility_updates and self.iteration != self._visible_since

    def update_visible(self, size: int | None = None) -> None:
        """Determine which splats the views see with the current weights; size: in pixels, by default the next
        iteration's."""
        with torch.no_grad():
            weights = self._weights()
        self._views.update_visible(lambda transforms: self._posed(weights, transforms), size or self.size_now())
        self._visible_since = self.iteration

    def try_out(self, size: int) -> None:
        """Do the work of an iteration at `size` px without changing the weights, to measure its time."""
        state = self._rng.bit_generator.state
        count = min(self.preset.batch, len(self.targets))
        self._descend(np.linspace(0, len(self.targets) - 1, count).astype(int).tolist(), size)
        self._rng.bit_generator.state = state

    def _weights(self) -> torch.Tensor:
        weights: torch.Tensor = self.field()
        return weights if self._movable is None else torch.where(self._movable, weights, self.field.initial())

    def _descend(self, batch: Sequence[int], size: int) -> dict[str, float]:
        """Backpropagate the loss on the targets `batch` into the field; returns the parts of the loss."""
        transforms = np.stack([self.targets[i].transforms for i in batch])
        weights = self._weights()
        if self._device_renderer is not None:
            render, nodes = self._device_renderer(weights, transforms, self._views.by_scene(batch, size))
        else:
            posed = self._poser.pose(weights, transforms)
            nodes = posed.nodes
            render = _Render.apply(posed.means, posed.quats, self._views, batch, size)  # type: ignore[no-untyped-call]
        parts = {"render": render}
        loss = render
        if self.losses.arap:
            parts["arap"] = self._arap(nodes)
            loss = loss + self.losses.arap * parts["arap"]
        if self.losses.coupling:
            parts["coupling"] = coupling_loss(self._coupling, nodes, transforms)
            loss = loss + self.losses.coupling * parts["coupling"]
        if self.losses.anchor:
            parts["anchor"] = self._prior_loss.loss(weights, self._rng)
            loss = loss + self.losses.anchor * parts["anchor"]
        self._adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        return {name: float(part.detach()) for name, part in parts.items()}

    def _make_device_renderer(
        self, cloud: SplatCloud, background: tuple[float, float, float]
    ) -> DeviceRenderer | None:
        """For vanilla splats and a rasteriser that takes torch tensors."""
        if self.rasterizer == "cpu" or not self.targets or not isinstance(self._poser, SplatPoser):
            return None
        device = tensor_device(self._views.scene(0, self.size_now()))
        return None if device is None else DeviceRenderer(cloud, device, background)

    def _posed(
        self, weights: torch.Tensor, transforms: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        with torch.no_grad():
            posed = self._poser.pose(weights, transforms)
        return posed.means.numpy(), posed.quats.numpy()

    def _decay(self) -> float:
        """Cosine from 1 to 0.1: early steps are large, the last ones settle."""
        part = self.iteration / max(self.preset.iterations, 1)
        return 0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * min(part, 1.0)))

    def _next_target(self) -> int:
        if not self._queue:
            self._queue = self._rng.permutation(len(self.targets)).tolist()
        return self._queue.pop()

    def _arap(self, posed: torch.Tensor) -> torch.Tensor:
        count = posed.shape[1]
        drawn = min(self.losses.arap_nodes or count, count)
        nodes = np.arange(count) if drawn == count else self._rng.choice(count, drawn, replace=False)
        near = self._neighbours[nodes]
        result: torch.Tensor = _Arap.apply(posed, self._nodes, nodes, near)  # type: ignore[no-untyped-call]
        return result / self._edge_square


class _Arap(torch.autograd.Function):
    @staticmethod
    def forward(ctx, posed, rest, nodes, neighbours):  # type: ignore[no-untyped-def]
        value, grad = arap_loss(rest, posed.detach().numpy(), nodes, neighbours)
        ctx.grad = torch.from_numpy(grad)
        return torch.tensor(value, dtype=posed.dtype)

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return ctx.grad * grad, None, None, None


class _Render(torch.autograd.Function):
    """The rendering loss as one node: value and gradients come from the rasteriser together."""

    @staticmethod
    def forward(ctx, means, quats, views, batch, size):  # type: ignore[no-untyped-def]
        value, *grads = views.render_and_grad(means.detach().numpy(), quats.detach().numpy(), batch, size)
        ctx.grads = [torch.from_numpy(grad) for grad in grads]
        return torch.tensor(value, dtype=means.dtype)

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return ctx.grads[0] * grad, ctx.grads[1] * grad, None, None, None
