# SPDX-License-Identifier: GPL-3.0-or-later
"""The long part of a job: guidance images and optimisation, with checkpoints, and an early end."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ..checkpoint import load_checkpoint, save_checkpoint
from ..errors import InputError, first_line
from ..files import remove_leftovers
from ..guidance.control import ControlSignal
from ..skinning.optimise import Optimiser
from ..skinning.presets import Preset
from ..skinning.views import Target
from .eta import Eta
from .live_pictures import LivePictures
from .previews import guidance_picture
from .work_kinds import FIT, checks_of, learning_kind, visibility_kind

TRIALS = 3
"""Iterations timed at each size before anything is learned: a single one may be off by a fifth."""
STATE, OLD_STATE = "optimiser.safetensors", "optimiser.pt"
CHECKPOINT_SECONDS = 5.0
# The weight volume's state has 450 MB: writing it may take up to this share of the time.
CHECKPOINT_SHARE = 0.1


def _first_visits(preset: Preset, images: int) -> frozenset[int]:
    """The iterations that use an image for the first time at a size and resize it: they take up to half as long
    again, which says nothing about the others."""
    epoch = math.ceil(images / max(1, min(preset.batch, images)))
    return frozenset(visit for _, stage in preset.ranges() for visit in stage[:epoch])


def try_out(optimiser: Optimiser, eta: Eta, images: int) -> None:
    """Measure what an iteration costs at each size, before anything is learned.

    images: number of images of the run; `optimiser` may have fewer.
    """
    scale = images / len(optimiser.targets)
    for size in dict.fromkeys(size for size, _ in optimiser.preset.stages):
        optimiser.try_out(size)  # loads the kernels
        eta.forget()
        if optimiser.visibility_updates:
            optimiser.update_visible(size)
            eta.record_trial(visibility_kind(size), 1 / scale)
        for _ in range(TRIALS):
            optimiser.try_out(size)
            eta.record_trial(learning_kind(size))


def make_guidance(
    provider: Any, signals: Sequence[ControlSignal], eta: Eta, pictures: LivePictures | None = None
) -> list[Target]:
    """The provider's images, one for each signal; `pictures` shows one now and then."""
    targets: list[Target] = []
    images = provider.images(signals)
    for number, signal in enumerate(signals):
        targets.append(Target(signal.camera, signal.transforms, next(images)))
        # The first one waits for whatever the provider must load or compute beforehand.
        eta.record("guidance" if number else "first image")
        eta.report("guidance", f"Guidance image {number + 1} of {len(signals)}")
        if pictures is not None and pictures.show("guidance", partial(guidance_picture, signal, targets[-1])):
            eta.forget()
    return targets


def optimise(
    optimiser: Optimiser, eta: Eta, checkpoint: Path, watch: Callable[[], bool] = lambda: False
) -> tuple[list[dict[str, float]], dict[str, float]]:
    """Run to the end, from the checkpoint if there is one; returns the losses of about 50 iterations, and what the
    field says of its start (`WeightField.fit`), if this process made it.

    watch: called after each iteration, for those who draw the weights now and then; true where it took time.
    """
    iterations = optimiser.preset.iterations
    history, remark = _load(optimiser, checkpoint)
    if remark:
        eta.report("optimise", remark)
    _skip_done(optimiser, eta)
    fitted = {} if optimiser.iteration else _fit(optimiser, eta)
    checks, every = checks_of(optimiser.preset), max(1, iterations // 50)
    slow = _first_visits(optimiser.preset, len(optimiser.targets))
    saved, cost = time.monotonic(), 0.0
    eta.forget()
    while optimiser.iteration < iterations and not optimiser.stop.reason:
        number, size = optimiser.iteration, optimiser.size_now()
        if optimiser.must_update_visible:
            optimiser.update_visible()
            eta.record(visibility_kind(size))
        parts = optimiser.step()
        if number in slow:
            eta.skip(learning_kind(size), 1)
            eta.forget()
        else:
            eta.record(learning_kind(size))
        if number % every == 0 or number == iterations - 1:
            history.append({"iteration": number, **parts})
        if optimiser.iteration in checks and optimiser.check() is not None:
            eta.record("check")
        begun = time.monotonic()
        if begun - saved > CHECKPOINT_SECONDS + cost / CHECKPOINT_SHARE:
            _save(optimiser, history, checkpoint)
            saved = time.monotonic()
            cost = saved - begun
            eta.forget()
        eta.report("optimise", f"Iteration {number + 1} of {iterations}", parts)
        if watch():
            eta.forget()
    optimiser.use_best()
    return history, fitted


def _fit(optimiser: Optimiser, eta: Eta) -> dict[str, float]:
    """Bring the field to the initial weights."""
    eta.forget()

    def tick(done: float) -> None:
        eta.record_up_to(FIT, done)
        eta.report("optimise", "Fitting the field to the initial weights")

    fitted = optimiser.field.fit(tick)
    if fitted:
        eta.skip_rest(FIT)
    return fitted


def _skip_done(optimiser: Optimiser, eta: Eta) -> None:
    """Count as done what was done before a stop."""
    reached, optimiser.iteration = optimiser.iteration, 0
    if reached:
        eta.skip_rest(FIT)
    for number in range(reached):
        optimiser.iteration = number
        size = optimiser.size_now()
        eta.skip(learning_kind(size), 1)
        if number in optimiser.visibility_updates:
            eta.skip(visibility_kind(size), 1)
        if number + 1 in checks_of(optimiser.preset):
            eta.skip("check", 1)
    optimiser.iteration = reached


def _save(optimiser: Optimiser, history: list[dict[str, float]], checkpoint: Path) -> None:
    state = optimiser.state()
    seen = [None if mask is None else torch.from_numpy(mask) for mask in state["seen"]]
    save_checkpoint(checkpoint / STATE, {"optimiser": {**state, "seen": seen}, "history": history})


def _load(optimiser: Optimiser, checkpoint: Path) -> tuple[list[dict[str, float]], str]:
    """Restore the optimiser to where a stopped run left it; returns that run's losses.

    A checkpoint that cannot be used is deleted, since its contents can be learned again; the second value then says
    so, otherwise it is empty. Those of gskin 0.1.0 were pickles, which can run code, and are not even opened.
    """
    remove_leftovers(checkpoint)
    path, old = checkpoint / STATE, checkpoint / OLD_STATE
    if old.exists() or old.is_symlink():
        old.unlink()
        if not path.is_file():
            return [], "The checkpoint of an older gskin is not read, the learning starts anew"
    if not path.is_file():
        return [], ""
    before = copy.deepcopy(optimiser.state())
    try:
        state = load_checkpoint(path)
        kept = state["optimiser"]
        optimiser.restore({**kept, "seen": [None if mask is None else mask.numpy() for mask in kept["seen"]]})
        if not 0 <= optimiser.iteration <= optimiser.preset.iterations:
            raise ValueError(f"iteration {optimiser.iteration}")
        return [dict(parts) for parts in state["history"]], ""
    # What a checkpoint of another version, or one that somebody made up, may stumble over.
    except (InputError, AttributeError, IndexError, KeyError, TypeError, ValueError, RuntimeError) as error:
        optimiser.restore(before)
        path.unlink()
        return [], f"The checkpoint cannot be used ({first_line(error)}), the learning starts anew"
