# SPDX-License-Identifier: GPL-3.0-or-later
"""Whole jobs in the worker's own process, and what they cost: wall, cores, memory; how well the end was foreseen."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assets import RiggedSplats
from gskin_addon.core.job.contract import write_job
from gskin_addon.core.worker import process


@dataclass(frozen=True)
class Cost:
    """wall, core: seconds of the process; report: the job's own; lines: (seconds since the start, news)."""

    wall: float
    core: float
    report: dict[str, Any]
    lines: list[tuple[float, dict[str, Any]]]

    @property
    def without_guidance(self) -> float:
        """Wall seconds of the run's stages but the making of guidance images."""
        return float(sum(seconds for stage, seconds in self.report["seconds"].items() if stage != "guidance"))

    @property
    def peak_mb(self) -> float:
        """Largest resident memory of the process, MB."""
        return float(self.report["worker"]["peak_memory_mb"])

    def forecast_error(self, part: float = 0.1) -> float:
        """How far the time left was off when `part` of the run was over, relative to the truth."""
        begun = next(at for at, line in self.lines if line["stage"] == "initial")
        end = self.lines[-1][0]
        now = begun + part * (end - begun)
        at, line = next((at, line) for at, line in self.lines if at >= now and line["seconds_left"] is not None)
        return abs(float(line["seconds_left"]) - (end - at)) / (end - at)


def run_job(asset: RiggedSplats, settings: dict[str, Any], threads: int = 0) -> Cost:
    """Run a job on an asset; with guidance `oracle` the asset's weights are the truth. Raises RuntimeError."""
    environment = dict(os.environ)
    if threads:
        environment |= {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    with tempfile.TemporaryDirectory(prefix="gskin-bench-") as folder:
        if settings.get("guidance") == "oracle":
            truth = Path(folder) / "truth.npz"
            np.savez(truth, weights=asset.weights)
            settings = {**settings, "options": {"oracle_weights": str(truth)}}
        job = write_job(Path(folder) / "job", asset.cloud, asset.skeleton, settings)
        command = [sys.executable, "-u", str(process.__file__), str(job)]
        before, begun = os.times(), time.perf_counter()
        lines: list[tuple[float, dict[str, Any]]] = []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as running:
            for text in running.stdout or ():
                lines.append((time.perf_counter() - begun, json.loads(text)))
        wall, after = time.perf_counter() - begun, os.times()
        if running.returncode != 0:
            raise RuntimeError(lines[-1][1].get("error", "the job failed") if lines else "the job failed")
        core = after.children_user + after.children_system - before.children_user - before.children_system
        report = json.loads((job / "report.json").read_text(encoding="utf-8"))
    return Cost(wall, core, report, lines)
