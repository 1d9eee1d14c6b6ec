# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network: batches of lessons, the loss, and a loop that can be stopped and taken up again."""

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
from .samples import Lesson, posed_lesson
from .torch_network import Answer, Batch, PriorNetwork, make_batch

CREATURES = "made by gskin"
"""The family of the generated creatures."""

ODD = {"Animalia": 0.25}
"""Families that count for less: boxes with rigid weights."""

POSES = 12

IDENTITY = (
    *BONE_FEATURES, "owned", "heat share", "closest splat", "strongest heat", "width", "bones", "pieces", "piece size",
    "heat piece", "nearest piece", "below piece",
)  # fmt: skip
"""Features by which a rig could be recognised."""

_IS_IDENTITY = np.array([name in IDENTITY for name in NAMES])
BLUR = np.where(_IS_IDENTITY, 0.12, 0.05).astype(np.float32)
"""Noise of each feature, the same for all splats near a bone, in standard deviations."""

HIDE = np.where(_IS_IDENTITY, 0.12, 0.04)
HIDE[PRIOR] = 0.0
"""Chance of each feature to be hidden in a lesson."""

NAMELESS, FORGOTTEN = 0.35, 0.1
"""Chances of a lesson without any names of bones, and of each bone to lose its name: many rigs have none that say what
a bone is for."""
_HIDDEN = ("layers.", "enter.2", "hear")
_MICRO = 2  # lessons at a time: small enough for the processor's cache, and for a quick end


@dataclass(frozen=True)
class Schedule:
    """steps of `lessons` bodies each; matrix_rate, rate: peaks of the learning rates of the hidden matrices and of all
    else; average: of the weights, over the last steps."""

    steps: int
    lessons: int = 4
    matrix_rate: float = 0.01
    rate: float = 2e-3
    average: float = 0.998
    seed: int = 0


class Syllabus:
    """Lesson files by family and asset; large families count less than their size."""

    def __init__(self, files: dict[str, dict[str, list[Path]]]) -> None:
        """files: family -> asset -> its lessons."""
        self.files = {family: list(assets.values()) for family, assets in sorted(files.items()) if assets}
        if not self.files:
            raise InputError("There is nothing to learn from: every family of the catalogue is left out.")
        count = np.array([len(assets) ** 0.65 * ODD.get(name, 1.0) for name, assets in self.files.items()])
        self._chance = count / count.sum()

    def draw(self, count: int, rng: np.random.Generator) -> list[Lesson]:
        """`count` lessons of different families, as far as there are enough."""
        families = list(self.files)
        replace = count > len(families)
        picked = rng.choice(len(families), count, replace=replace, p=self._chance)
        out = []
        for number in picked:
            assets = self.files[families[number]]
            lessons = assets[rng.integers(len(assets))]
            out.append(Lesson.load(lessons[rng.integers(len(lessons))]))
        return out


def normalise(network: PriorNetwork, lessons: Sequence[Lesson]) -> None:
    """Set the network's input mean and deviation from some lessons."""
    rows = np.concatenate([lesson.values[lesson.bone >= 0].astype(np.float32) for lesson in lessons])
    network.mean.copy_(torch.from_numpy(rows.mean(axis=0)))
    network.deviation.copy_(torch.from_numpy(np.maximum(rows.std(axis=0), 0.05)))


def lesson_loss(answer: Answer, batch: Batch, lessons: Sequence[Lesson], poses: Sequence[NDArray[Any]]) -> Tensor:
    """Sum over the lessons of: posed-position error relative to that of the heat weights, cross-entropy of both
    softmaxes, and how badly the doubt is judged."""
    total = answer.final.new_zeros(())
    for (rows, *_), lesson, pose in zip(batch.bodies, lessons, poses, strict=True):
        valid = torch.from_numpy(lesson.valid)
        truth = torch.from_numpy(lesson.truth.astype(np.float32))
        bone = batch.bone[rows]
        at, missing = bone.clamp(min=0), bone < 0
        target = truth.gather(1, at).masked_fill(missing, 0)
        share = answer.final[rows].softmax(-1)
        error = posed_error(share, truth, at, lesson, pose)[:, valid].mean()
        total = total + error / (float(lesson.difficulty) + 0.1)
        for logits, weight in ((answer.final[rows], 0.3), (answer.first[rows], 0.2)):
            total = total - weight * (target * logits.log_softmax(-1)).sum(-1)[valid].mean()
        wrong = 0.5 * ((share - target).abs().sum(-1) + 1 - target.sum(-1)).detach().clamp(0, 1)
        doubt = torch.nn.functional.binary_cross_entropy_with_logits(answer.doubt[rows], wrong, reduction="none")
        total = total + 0.1 * doubt[valid].mean()
    return total


def posed_error(share: Tensor, truth: Tensor, bone: Tensor, lesson: Lesson, poses: NDArray[Any]) -> Tensor:
    """(P, N) distance between a splat posed by shares (N, K) of bones (N, K) and by its true weights (N, B), in % of
    the diagonal."""
    matrix = torch.from_numpy(poses.astype(np.float32))
    points = torch.from_numpy(lesson.points)
    moved = torch.einsum("pbij,nj->pnbi", matrix[..., :3, :3], points) + matrix[:, None, :, :3, 3]
    wanted = torch.einsum("nb,pnbi->pni", truth, moved)
    picked = moved.gather(2, bone[None, :, :, None].expand(len(moved), -1, -1, 3))
    got = torch.einsum("nk,pnki->pni", share, picked)
    return 100 * ((got - wanted).square().sum(-1) + 1e-9).sqrt()


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """An interrupt waits until the end of the block, so that no step is half done."""
    if threading.current_thread() is not threading.main_thread():
        yield  # interrupts reach the main thread only
        return
    heard: list[tuple[int, Any]] = []
    previous = signal.signal(signal.SIGINT, lambda number, frame: heard.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if previous is None else previous)
    if heard and callable(previous):
        previous(*heard[0])


class Trainer:
    """The network, its optimiser, and the running mean of its weights, which is what is kept in the end."""

    def __init__(self, syllabus: Syllabus, schedule: Schedule, shape: Shape | None = None) -> None:
        torch.manual_seed(schedule.seed)
        self.syllabus, self.schedule = syllabus, schedule
        self.network = PriorNetwork(shape)
        normalise(self.network, syllabus.draw(40, np.random.default_rng(schedule.seed)))
        hidden = [p for name, p in self.network.named_parameters() if p.ndim == 2 and name.startswith(_HIDDEN)]
        chosen = {id(p) for p in hidden}
        rest = [p for p in self.network.parameters() if id(p) not in chosen]
        self._optimisers: list[tuple[torch.optim.Optimizer, float]] = [
            (Muon(hidden, lr=schedule.matrix_rate), schedule.matrix_rate),
            (torch.optim.AdamW(rest, lr=schedule.rate, betas=(0.9, 0.98), weight_decay=0.0), schedule.rate),
        ]
        self._mean = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.step_number = 0
        self.losses: list[float] = []
        self._random = torch.get_rng_state()  # of the dropout, after the last whole step

    def step(self) -> float:
        """One step; returns the mean loss of its lessons. Equal seeds give equal steps, stopped in between or not."""
        schedule = self.schedule
        rng = np.random.default_rng([schedule.seed, self.step_number])
        torch.set_rng_state(self._random)
        lessons = self.syllabus.draw(schedule.lessons, rng)
        self.network.zero_grad()
        total = 0.0
        for first in range(0, len(lessons), _MICRO):
            part = lessons[first : first + _MICRO]
            batch = make_batch([vars(lesson) for lesson in part])
            for (rows, *_), lesson in zip(batch.bodies, part, strict=True):
                self._blur(batch.values[rows], lesson, rng)
                self._forget(batch.role[rows], lesson, rng)
            poses = [posed_lesson(lesson, POSES, rng) for lesson in part]
            loss = lesson_loss(self.network(batch), batch, part, poses) / len(lessons)
            loss.backward()  # type: ignore[no-untyped-call]
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        with _undisturbed():
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

    def _blur(self, values: Tensor, lesson: Lesson, rng: np.random.Generator) -> None:
        """Hide or disturb, in place, what could betray which rig this is: the network shall learn from shapes."""
        mean, deviation = self.network.mean, self.network.deviation
        bone = lesson.bone.astype(np.int64)
        by_bone = rng.standard_normal((len(lesson.heads) + 1, len(NAMES)), np.float32) * BLUR[None]
        by_token = rng.standard_normal(values.shape, np.float32) * np.float32(0.05)
        values += torch.from_numpy(by_bone[bone] + by_token) * deviation
        hidden = torch.from_numpy(rng.random(len(NAMES)) < HIDE)
        values[..., hidden] = mean[hidden]

    def _forget(self, role: Tensor, lesson: Lesson, rng: np.random.Generator) -> None:
        """Take names away, in place."""
        lost = rng.random(len(lesson.heads)) < (1.0 if rng.random() < NAMELESS else FORGOTTEN)
        role[torch.from_numpy(lost[lesson.bone])] = 0  # nothing reads the role where there is no bone (-1)

    def _share(self) -> float:
        """Of the peak learning rate: a short rise, then half a cosine down to a third.

        Lower, the network learns the training families by heart: errors on other families rise again.
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
        """Leave a checkpoint of the last whole step."""
        state = {
            "schedule": vars(self.schedule),
            "features": NAMES,
            "families": sorted(self.syllabus.files),
            "network": self.network.state_dict(),
            "mean": self._mean,
            "optimisers": [optimiser.state_dict() for optimiser, _ in self._optimisers],
            "step": self.step_number,
            "losses": self.losses,
            "random": self._random,
        }
        save_checkpoint(path, state)

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint.

        Raises:
            InputError: it cannot be read, is of an older gskin, or belongs to another schedule, version or choice of
                families.
        """
        state = load_checkpoint(path)
        same = (
            state.get("schedule") == vars(self.schedule)
            and state.get("features") == NAMES
            and state.get("families") == sorted(self.syllabus.files)
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
