# SPDX-License-Identifier: GPL-3.0-or-later
"""Methods on one asset: make weights, judge them. What a worker process does."""

from __future__ import annotations

import resource
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.assets import load_asset

from .cases import ANCHORED, CASES, judge_of
from .catalog import entry_of
from .lpips import Perceptual
from .methods import MethodInput, Unavailable, create_method
from .methods.base import MethodResult, rigid_weights
from .protocol import Protocol
from .results import FAILED, OK, OWN, PARTLY, Result, save_weights, weights_path


@dataclass(frozen=True)
class Task:
    """Methods to run on one asset with one skeleton.

    failed: methods that a worker died of or that took too long, and how; they are only scored as failures.
    """

    asset: str
    skeleton: str
    methods: tuple[str, ...]
    failed: tuple[tuple[str, str], ...] = ()


Message = tuple[Any, ...]
"""("start", method, limit in seconds), ("made", method), ("result", Result) or ("unavailable", method, why)."""


def limit_cpu(seconds: float | None) -> None:
    """Let the kernel end this process (SIGXCPU) after so many core-seconds more; None lifts the limit.

    Core-seconds do not depend on what else runs on the machine.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    soft = resource.RLIM_INFINITY if seconds is None else int(time.process_time() + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))


def perform(task: Task, protocol: Protocol, folder: Path, lpips: Perceptual | None) -> Iterator[Message]:
    """Do the task; says what it is at, so that somebody can watch. Seconds are core-seconds of this process."""
    yield "start", "(loading)", 120.0
    asset = load_asset(task.asset, protocol.splats, protocol.seed, unused_bones=protocol.unused_bones)
    case = CASES[task.skeleton](asset)
    judge = judge_of(task.skeleton, case.asset, protocol, lpips)
    subject = MethodInput(case.asset, case.skeleton, case.truth)
    assert subject.masks.size  # made here, so that no method pays for them
    entry = entry_of(task.asset)

    def judged(method: str, made: MethodResult, status: str, seconds: float | None) -> Result:
        weights = made.weights @ case.fold
        if task.skeleton == OWN and status != FAILED:
            save_weights(weights_path(folder, task.asset, method, protocol.key), weights)
        if task.skeleton == ANCHORED and made.mesh_weights is not None:
            weights = made.mesh_weights @ case.fold
        return Result(
            task.asset, entry.category, entry.family, method, task.skeleton, protocol.key, case.skeleton.count,
            status, made.note, seconds, asdict(judge.score(weights)),
        )  # fmt: skip

    def lost(why: str) -> MethodResult:
        return MethodResult(rigid_weights(subject.cloud.means, subject.skeleton), why)

    for method, why in task.failed:
        yield "result", judged(method, lost(why), FAILED, None)
    for method in task.methods:
        started = time.process_time()
        try:
            chosen = create_method(method)
            yield "start", method, chosen.limit
            limit_cpu(chosen.limit)
            started = time.process_time()
            made = chosen.make(subject)
            status = PARTLY if made.partly else OK
        except Unavailable as reason:
            yield "unavailable", method, str(reason)
            continue
        except Exception as error:  # a method's failure is a result, whatever it is
            where = traceback.extract_tb(error.__traceback__)[-1]
            made = lost(f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})")
            status = FAILED
        finally:
            limit_cpu(None)
        seconds = time.process_time() - started
        yield "made", method
        yield "result", judged(method, made, status, round(seconds, 2))


def order_methods(methods: Sequence[str]) -> tuple[str, ...]:
    """The methods with those last that may be stopped by the clock, since a stop costs the loaded asset."""
    return tuple(sorted(methods, key=lambda m: m in ("bbw", "oracle") or m.startswith(("ours:", "job:"))))
