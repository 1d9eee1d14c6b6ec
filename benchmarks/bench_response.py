# SPDX-License-Identifier: GPL-3.0-or-later
"""How soon gskin answers whoever waits: a file that is read, a window that asks for news, a job that is cancelled.

Part of `make bench-speed`: python -m benchmarks.bench_speed --only response
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import figure
from gskin_addon.core.job.contract import write_job
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.core.worker.client import WorkerClient

STAGES = ("initial", "optimise")
"""Stages of a job at which it is cancelled: long compiled calls in the one, many short ones in the other."""

_SETTINGS = {"guidance": "elastic", "rasterizer": "cpu", "preset": "standard"}


@dataclass
class Answers:
    """Seconds of single calls: polls of a running job, `cancel`, and from that to the job's end."""

    poll: list[float] = field(default_factory=list)
    cancel: list[float] = field(default_factory=list)
    end: list[float] = field(default_factory=list)


def read_seconds(repeats: int, splats: int = 100_000) -> float:
    """Median seconds of reading a binary PLY with spherical harmonics of degree 3."""
    cloud = figure(splats, 5).cloud
    cloud = replace(cloud, sh=np.random.default_rng(0).normal(size=(splats, 16, 3)))
    with tempfile.TemporaryDirectory(prefix="gskin-bench-") as folder:
        path = Path(folder) / "figure.ply"
        write_ply(path, cloud)
        return float(np.median([_timed(lambda: read_ply(path))[0] for _ in range(repeats)]))


def cancel_jobs(repeats: int, splats: int = 50_000) -> Answers:
    """Cancel jobs in each of STAGES, and (POSIX) ones whose process hears nothing any more."""
    answers = Answers()
    for _ in range(repeats):
        for stage in STAGES:
            with _job(splats) as client:
                _follow_to(client, stage, answers)
                _cancel(client, answers)
        if os.name == "posix":
            with _job(splats) as client:
                _follow_to(client, STAGES[0], answers)
                assert client._process is not None
                client._process.send_signal(signal.SIGSTOP)
                _cancel(client, answers)
    return answers


@contextmanager
def _job(splats: int) -> Iterator[WorkerClient]:
    asset = figure(splats, 20)
    with tempfile.TemporaryDirectory(prefix="gskin-bench-") as folder:
        job = write_job(Path(folder) / "job", asset.cloud, asset.skeleton, _SETTINGS)
        client = WorkerClient(sys.executable, job)
        client.start()
        try:
            yield client
        finally:
            client.stop()


def _follow_to(client: WorkerClient, stage: str, answers: Answers) -> None:
    while True:
        seconds, events = _timed(client.poll)
        answers.poll.append(seconds)
        if any(event.stage == stage for event in events):
            return
        if client.state != "running":
            raise RuntimeError(f"The job ended before it came to '{stage}': {client.error}")
        time.sleep(0.02)


def _cancel(client: WorkerClient, answers: Answers) -> None:
    began = time.perf_counter()
    answers.cancel.append(_timed(client.cancel)[0])
    while client.state == "running":
        client.poll()
        time.sleep(0.005)
    answers.end.append(time.perf_counter() - began)


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    answer = call()
    return time.perf_counter() - began, answer
