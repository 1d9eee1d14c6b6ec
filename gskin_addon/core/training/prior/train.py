# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network: batches of samples, the loss, and a loop that can be stopped and resumed."""

from __future__ import annotations

import contextlib
import math
import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...checkpoint import load_checkpoint, save_checkpoint
from ...errors import InputError, first_line
from ...skinning.learned.features import NAMES, PRIOR
from ...skinning.learned.network import Shape
from ...skinning.learned.tree import BONE_FEATURES
from .muon import Muon
from .samples import TrainingSample, random_sample_poses
from .sampling_plan import SamplingPlan
from .torch_network import BodyBatch, NetworkOutput, PriorNetwork, make_batch

POSES = 12

IDENTITY = (
    *BONE_FEATURES, "owned", "heat share", "closest splat", "strongest heat", "width", "bones", "pieces", "piece size",
    "heat piece", "nearest piece", "below piece",
)  # fmt: skip
"""Features that could identify a rig."""

_IS_IDENTITY = np.array([name in IDENTITY for name in NAMES])
FEATURE_NOISE = np.where(_IS_IDENTITY, 0.12, 0.05).astype(np.float32)
"""Standard deviation of the noise on each feature, the same for all splats near a bone, in standard deviations of
the feature."""

FEATURE_DROPOUT = np.where(_IS_IDENTITY, 0.12, 0.04)
FEATURE_DROPOUT[PRIOR] = 0.0
"""Probability that each feature is hidden in a sample."""

ALL_NAMES_DROPOUT, NAME_DROPOUT = 0.35, 0.1
"""Probabilities that a sample has no bone names at all, and that a bone loses its name: in many rigs names do not say
what a bone is for."""
_MATRICES = ("layers.", "enter.2", "hear")
_MICRO_BATCH = 2  # samples at a time: few enough for the processor's cache, and for a quick stop


@dataclass(frozen=True)
class Schedule:
    """steps, each on `samples` training samples; matrix_rate, rate: peak learning rates of the hidden matrices and of
    the other parameters; average: decay of the running mean of the weights, per step."""

    steps: int
    samples: int = 4
    matrix_rate: float = 0.01
    rate: float = 2e-3
    average: float = 0.998
    seed: int = 0

    def as_dict(self) -> dict[str, float]:
        """As in a checkpoint, where `samples` has the name that it had when the format was made."""
        return {"lessons" if name == "samples" else name: value for name, value in vars(self).items()}


def set_input_normalisation(network: PriorNetwork, samples: Sequence[TrainingSample]) -> None:
    """Set the network's input mean and deviation from some samples."""
    rows = np.concatenate([sample.values[sample.bone >= 0].astype(np.float32) for sample in samples])
    network.mean.copy_(torch.from_numpy(rows.mean(axis=0)))
    network.deviation.copy_(torch.from_numpy(np.maximum(rows.std(axis=0), 0.05)))


def training_loss(
    answer: NetworkOutput, batch: BodyBatch, samples: Sequence[TrainingSample], poses: Sequence[NDArray[Any]]
) -> Tensor:
    """Sum over the samples of: posed-position error relative to that of the heat weights, cross-entropy of both
    softmaxes, and the error of the predicted doubt."""
    total = answer.final.new_zeros(())
    for (rows, *_), sample, pose in zip(batch.bodies, samples, poses, strict=True):
        valid = torch.from_numpy(sample.valid)
        truth = torch.from_numpy(sample.truth.astype(np.float32))
        bone = batch.bone[rows]
        at, missing = bone.clamp(min=0), bone < 0
        target = truth.gather(1, at).masked_fill(missing, 0)
        share = answer.final[rows].softmax(-1)
        error = posed_error(share, truth, at, sample, pose)[:, valid].mean()
        total = total + error / (float(sample.difficulty) + 0.1)
        for logits, weight in ((answer.final[rows], 0.3), (answer.first[rows], 0.2)):
            total = total - weight * (target * logits.log_softmax(-1)).sum(-1)[valid].mean()
        wrong = 0.5 * ((share - target).abs().sum(-1) + 1 - target.sum(-1)).detach().clamp(0, 1)
        doubt = torch.nn.functional.binary_cross_entropy_with_logits(answer.doubt[rows], wrong, reduction="none")
        total = total + 0.1 * doubt[valid].mean()
    return total


def posed_error(share: Tensor, truth: Tensor, bone: Tensor, sample: TrainingSample, poses: NDArray[Any]) -> Tensor:
    """(P, N) distance between a splat posed by shares (N, K) of bones (N, K) and by its true weights (N, B), in % of
    the diagonal."""
    matrix = torch.from_numpy(poses.astype(np.float32))
    points = torch.from_numpy(sample.points)
    moved = torch.einsum("pbij,nj->pnbi", matrix[..., :3, :3], points) + matrix[:, None, :, :3, 3]
    wanted = torch.einsum("nb,pnbi->pni", truth, moved)
    picked = moved.gather(2, bone[None, :, :, None].expand(len(moved), -1, -1, 3))
    got = torch.einsum("nk,pnki->pni", share, picked)
    return 100 * ((got - wanted).square().sum(-1) + 1e-9).sqrt()


@contextlib.contextmanager
def _deferred_interrupts() -> Iterator[None]:
    """Deliver an interrupt after the block, so that no step is left half done."""
    if threading.current_thread() is not threading.main_thread():
        yield  # interrupts reach the main thread only
        return
    interrupts: list[tuple[int, Any]] = []
    previous = signal.signal(signal.SIGINT, lambda number, frame: interrupts.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if previous is None else previous)
    if interrupts and callable(previous):
        previous(*interrupts[0])


class Trainer:
    """The network, its optimisers, and the running mean of its weights, which becomes the model."""

    def __init__(self, sampling_plan: SamplingPlan, schedule: Schedule, shape: Shape | None = None) -> None:
        torch.manual_seed(schedule.seed)
        self.sampling_plan, self.schedule = sampling_plan, schedule
        self.network = PriorNetwork(shape)
        set_input_normalisation(self.network, sampling_plan.draw(40, np.random.default_rng(schedule.seed)))
        hidden = [p for name, p in self.network.named_parameters() if p.ndim == 2 and name.startswith(_MATRICES)]
        chosen = {id(p) for p in hidden}
        rest = [p for p in self.network.parameters() if id(p) not in chosen]
        self._optimisers: list[tuple[torch.optim.Optimizer, float]] = [
            (Muon(hidden, lr=schedule.matrix_rate), schedule.matrix_rate),
            (torch.optim.AdamW(rest, lr=schedule.rate, betas=(0.9, 0.98), weight_decay=0.0), schedule.rate),
        ]
        self._mean = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.step_number = 0
        self.losses: list[float] = []
        self._random = torch.get_rng_state()  # of the dropout, after the last complete step

    def step(self) -> float:
        """One step; returns the mean loss of its samples. Equal seeds give equal steps, even after a stop."""
        schedule = self.schedule
        rng = np.random.default_rng([schedule.seed, self.step_number])
        torch.set_rng_state(self._random)
        samples = self.sampling_plan.draw(schedule.samples, rng)
        self.network.zero_grad()
        total = 0.0
        for first in range(0, len(samples), _MICRO_BATCH):
            part = samples[first : first + _MICRO_BATCH]
            batch = make_batch([vars(sample) for sample in part])
            for (rows, *_), sample in zip(batch.bodies, part, strict=True):
                self._perturb_features(batch.values[rows], sample, rng)
                self._hide_names(batch.role[rows], sample, rng)
            poses = [random_sample_poses(sample, POSES, rng) for sample in part]
            loss = training_loss(self.network(batch), batch, part, poses) / len(samples)
            loss.backward()  # type: ignore[no-untyped-call]
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        with _deferred_interrupts():
            for optimiser, rate in self._optimisers:
                for group in optimiser.param_groups:
                    group["lr"] = rate * self._share()
                optimiser.step()
            self.step_number += 1
            keep = min(schedule.average, self.step_number / (self.step_number + 10))
            for name, value in self.network.state_dict().items():
                self._mean[name].lerp_(value, 1 - keep)
            self.losses.append(total)
            self._random = torch.get_rng_state()
        return total

    def _perturb_features(self, values: Tensor, sample: TrainingSample, rng: np.random.Generator) -> None:
        """Hide features or add noise to them, in place, so that the network cannot recognise rigs."""
        mean, deviation = self.network.mean, self.network.deviation
        bone = sample.bone.astype(np.int64)
        by_bone = rng.standard_normal((len(sample.heads) + 1, len(NAMES)), np.float32) * FEATURE_NOISE[None]
        by_token = rng.standard_normal(values.shape, np.float32) * np.float32(0.05)
        values += torch.from_numpy(by_bone[bone] + by_token) * deviation
        hidden = torch.from_numpy(rng.random(len(NAMES)) < FEATURE_DROPOUT)
        values[..., hidden] = mean[hidden]

    def _hide_names(self, role: Tensor, sample: TrainingSample, rng: np.random.Generator) -> None:
        """Remove bone names at random, in place."""
        lost = rng.random(len(sample.heads)) < (1.0 if rng.random() < ALL_NAMES_DROPOUT else NAME_DROPOUT)
        role[torch.from_numpy(lost[sample.bone])] = 0  # nothing reads the role where there is no bone (-1)

    def _share(self) -> float:
        """Current share of the peak learning rate: a short warm-up, then half a cosine down to 0.3.

        With a lower end the network overfits: errors on other families rise again.
        """
        warm = min(1.0, (self.step_number + 1) / 60)
        done = self.step_number / self.schedule.steps
        return warm * (0.3 + 0.7 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0))))

    def result(self) -> PriorNetwork:
        """The network with the running mean of its weights."""
        network = PriorNetwork(self.network.shape)
        network.load_state_dict(self._mean)
        return network.eval()

    def save(self, path: Path) -> None:
        """Write a checkpoint of the last complete step."""
        state = {
            "schedule": self.schedule.as_dict(),
            "features": NAMES,
            "families": sorted(self.sampling_plan.files),
            "network": self.network.state_dict(),
            "mean": self._mean,
            "optimisers": [optimiser.state_dict() for optimiser, _ in self._optimisers],
            "step": self.step_number,
            "losses": self.losses,
            "random": self._random,
        }
        save_checkpoint(path, state)

    def restore(self, path: Path) -> None:
        """Continue from a checkpoint.

        Raises:
            InputError: it cannot be read, is of an older gskin, or belongs to another schedule, version or choice of
                families.
        """
        state = load_checkpoint(path)
        same = (
            state.get("schedule") == self.schedule.as_dict()
            and state.get("features") == NAMES
            and state.get("families") == sorted(self.sampling_plan.files)
        )
        if not same:
            raise InputError(f"'{path}' was left by a training with other settings; delete it to start anew.")
        try:
            self.network.load_state_dict(state["network"])
            self.result().load_state_dict(state["mean"])
            self._mean = state["mean"]
            for (optimiser, _), kept in zip(self._optimisers, state["optimisers"], strict=True):
                optimiser.load_state_dict(kept)
            self.step_number, self.losses = int(state["step"]), [float(loss) for loss in state["losses"]]
            torch.set_rng_state(state["random"])
            self._random = state["random"]
        except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(f"'{path}' does not fit this training ({first_line(error)}); delete it.") from error
