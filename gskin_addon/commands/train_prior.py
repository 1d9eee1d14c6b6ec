# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin train-prior`: learn initial weights from rigged assets. Needs torch, not Blender."""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import InputError
from ..core.job.progress import ProgressEvent
from ..core.job.progress_text import ProgressPrinter
from ..core.pipeline.eta import StageEta
from .console import print_message
from .paths import check_output

if TYPE_CHECKING:
    from ..core.training.prior.sampling_plan import SamplingPlan
    from ..core.training.prior.train import Trainer

_MODULES = ("torch", "numba", "scipy", "safetensors")
_CHECKPOINT_SECONDS = 30.0


def run(options: argparse.Namespace) -> None:
    """Train and write the model. Stopped, it leaves a checkpoint that the same command goes on from."""
    check_output(options.out, "--out", (".safetensors",))
    missing = [name for name in _MODULES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"Training needs {', '.join(missing)} in this Python; install with pip install 'gskin_addon[worker]'."
        )
    import torch

    from ..core.training.catalogue import list_assets
    from ..core.training.prior.sampling_plan import ALWAYS_LEFT_OUT, FOLDS, make_samples, plan_samples

    torch.set_num_threads(options.threads)
    assets = list_assets(options.assets, near_duplicates=True)
    left = tuple(dict.fromkeys((*options.leave_out, *FOLDS.get(options.fold, ()), *ALWAYS_LEFT_OUT)))
    if options.fold and options.fold not in FOLDS:
        raise InputError(f"There is no fold '{options.fold}'; choose one of {', '.join(FOLDS)}.")
    every = list_assets(options.assets, any_licence=True, near_duplicates=True) if options.leave_out else []
    unknown = sorted(set(options.leave_out) - {asset.family for asset in every})
    if unknown:
        raise InputError(f"--leave-out '{unknown[0]}' is no family of '{options.assets}'; see its catalog.json.")
    cache = options.cache or options.out.with_suffix(".lessons")
    printer = ProgressPrinter(options.progress)
    try:
        clock = _Clock(printer)
        requests = plan_samples(assets, left, options.creatures)
        sampling_plan = make_samples(requests, cache, lambda done, all_: clock("samples", done / all_, 0.0, 0.3))
        _train(options, sampling_plan, left, clock)
    finally:
        printer.close()
    print_message(f"The model is in '{options.out}'.")


def _train(options: argparse.Namespace, sampling_plan: SamplingPlan, left: tuple[str, ...], clock: _Clock) -> None:
    from ..core.skinning.learned.model_file import ModelCard
    from ..core.training.prior.train import Schedule, Trainer
    from ..core.training.prior.write_model import save_model

    seeds = range(options.seed, options.seed + options.networks)
    trainers = [Trainer(sampling_plan, Schedule(steps=options.steps, seed=seed)) for seed in seeds]
    kept = [options.out.with_suffix(f".{number}.checkpoint") for number in range(options.networks)]
    for trainer, checkpoint in zip(trainers, kept, strict=True):
        if checkpoint.is_file():
            trainer.restore(checkpoint)
    first = sum(trainer.step_number for trainer in trainers)
    missing = options.steps * len(trainers) - first

    def report(message: str) -> None:
        done = sum(trainer.step_number for trainer in trainers) - first
        clock("train", done / missing, 0.3, 1.0, message)

    clock.restart()
    for trainer, checkpoint in zip(trainers, kept, strict=True):
        _finish(trainer, checkpoint, report)
    losses = [loss for trainer in trainers for loss in trainer.losses[-50:]]
    training = {
        "steps": options.steps, "seed": options.seed, "creatures": options.creatures,
        "loss": round(sum(losses) / max(len(losses), 1), 4),
    }  # fmt: skip
    card = ModelCard(left, tuple(sorted(sampling_plan.files)), training)
    save_model([trainer.result() for trainer in trainers], Path(options.out), card)
    for checkpoint in kept:
        checkpoint.unlink(missing_ok=True)


def _finish(trainer: Trainer, checkpoint: Path, report: Callable[[str], None]) -> None:
    """All steps that are missing; the checkpoint stays until the model is written."""
    saved, steps = time.monotonic(), trainer.schedule.steps
    try:
        while trainer.step_number < steps:
            loss = trainer.step()
            report(f"seed {trainer.schedule.seed}, step {trainer.step_number} of {steps}, loss {loss:.3f}")
            if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                trainer.save(checkpoint)
                saved = time.monotonic()
    except KeyboardInterrupt:
        print_message(f"Stopped at step {trainer.step_number}; the same command goes on from '{checkpoint}'.")
        raise
    finally:
        trainer.save(checkpoint)


class _Clock:
    """Progress events with an estimate of the time left in the present stage."""

    def __init__(self, printer: ProgressPrinter) -> None:
        self._printer = printer
        self.restart()

    def restart(self) -> None:
        """A stage begins."""
        self._eta = StageEta()

    def __call__(self, stage: str, part: float, start: float, end: float, message: str = "") -> None:
        """`part` of the stage is done, which spans `start` to `end` of the whole."""
        left = self._eta.seconds_left(part)
        self._printer(ProgressEvent(stage, start + (end - start) * part, left, message=message))
