# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin train-guidance`: rigged models as assets, image pairs of these, a model fine-tuned on the pairs (Sec. IV)."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util

from ..core.errors import InputError, Stopped
from ..core.job.progress import ProgressEvent
from ..core.job.progress_text import ProgressPrinter
from ..core.pipeline.eta import StageEta
from .console import print_message
from .job_settings import parse_options


def run(options: argparse.Namespace) -> None:
    """Do the chosen step. Raises InputError for what cannot be used, Stopped when the person ends it."""
    lacking = [name for name in options.needs if importlib.util.find_spec(name) is None]
    if lacking:
        raise InputError(
            f"This Python has no {lacking[0]}; pip install '{options.extra}' and run the same command with that "
            "environment's gskin."
        )
    reporter = Reporter(options.step, options.progress)
    with contextlib.closing(reporter):
        try:
            {"import": _import, "pairs": _pairs, "tune": _tune}[options.step](options, reporter)
        except KeyboardInterrupt:
            raise Stopped(
                f"Stopped; what is finished stays in '{options.out}', and the same command goes on from there."
            ) from None


class Reporter:
    """Shows (done part, words) with the time left, as the worker does."""

    def __init__(self, stage: str, mode: str) -> None:
        self._stage, self._printer, self._eta = stage, ProgressPrinter(mode), StageEta()

    def __call__(self, done: float, message: str) -> None:
        left = self._eta.seconds_left(done)
        self._printer(ProgressEvent(self._stage, done, left, message=message))

    def close(self) -> None:
        """End an open bar."""
        self._printer.close()


def _import(options: argparse.Namespace, reporter: Reporter) -> None:
    from .import_rigged import run as import_files

    sentence = import_files(options, reporter)
    reporter.close()
    if sentence:
        print_message(sentence)


def _pairs(options: argparse.Namespace, reporter: Reporter) -> None:
    from ..core.training.guidance.make_pairs import PairSettings, make_pairs

    settings = PairSettings(
        poses_per_view=options.poses,
        size=options.size,
        splats=options.splats,
        seed=options.seed,
        validation=options.validation,
        per_family=options.per_family,
        leave_out=tuple(options.leave_out),
        any_licence=options.any_licence,
        true_masks=options.true_masks,
    )
    made = make_pairs(options.assets, options.out, settings, reporter)
    reporter.close()
    for name, reason in made["failed"].items():
        print_message(f"'{name}' was left out: {reason}")
    count = {split: sum(s["pairs"] for s in made["shards"] if s["split"] == split) for split in ("train", "validation")}
    pairs = f"{count['train']:,} pairs to train on and {count['validation']:,} to validate"
    print_message(f"'{options.out}' holds {pairs}.")


def _tune(options: argparse.Namespace, reporter: Reporter) -> None:
    if options.model == "flux2":
        from ..core.training.guidance.flux2_tune import tune
    else:
        from ..core.training.guidance.finetune import tune

    settings = parse_options(options.option, "--option")
    sentence = tune(options.pairs, options.out, settings, reporter, allow_download=options.allow_download)
    reporter.close()
    print_message(sentence)
