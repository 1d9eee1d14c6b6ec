# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiling kernels in advance: a tiny picture and two tiny jobs, whose results are discarded, fill the user's cache.

`python .../core/worker/process.py --warm` runs it and prints JSON lines like a job. If the cache is warm already, it
takes the few seconds in which torch loads.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..job.contract import write_job
from ..job.mesh_files import write_mesh
from ..job.progress import CancelFlag
from ..render.cpu import still
from ..rig.skeleton import Skeleton
from ..skinning.presets import PRESETS, Preset
from ..splats.cloud import SplatCloud
from . import job_runner, parent_watch

_TINY = Preset("Compiles everything, learns nothing", 1, ((256, 1), (512, 1)), 2)
_NAME = "warm"
_SPLATS, _RINGS, _SIDES = 300, 13, 8


def main() -> int:
    """Compile with low priority; ends when a piped stdin closes. Returns the exit code."""
    send = job_runner.take_stdout()
    pipe = parent_watch.take_stdin()
    if pipe is not None:
        parent_watch.on_close(pipe, lambda: os._exit(130))
    if hasattr(os, "nice"):
        os.nice(10)
    try:
        warm(send)
        return 0
    except Exception as error:
        code, sentence, details = job_runner.explain(error)
        send({"stage": "error", "error": sentence, "traceback": details, "exit_code": code})
        return code


def warm(send: Callable[[dict[str, Any]], None]) -> None:
    """Draw a picture, and run a job of each kind - splats alone, splats on a mesh - so that all kernels are compiled
    and cached."""
    begun = time.monotonic()
    still.compile_kernel()
    jobs: tuple[dict[str, Any], ...] = ({"init": "learned"}, {"init": "visibility", "mesh": True})
    PRESETS[_NAME] = _TINY
    try:
        for number, settings in enumerate(jobs):
            with tempfile.TemporaryDirectory(prefix="gskin-warm-") as folder:
                settings |= {"preset": _NAME, "guidance": "elastic"}
                _run(Path(folder), settings, _PartialProgress(send, number / len(jobs), 1 / len(jobs)))
    finally:
        del PRESETS[_NAME]
    seconds = round(time.monotonic() - begun, 1)
    send({"stage": "done", "fraction": 1.0, "seconds_left": 0.0, "message": f"Ready after {seconds} s"})


def _run(folder: Path, settings: dict[str, Any], send: Callable[[dict[str, Any]], None]) -> None:
    cloud, skeleton, verts, faces = _limb()
    if settings.get("mesh"):
        settings["mesh"] = write_mesh(folder, verts, faces)
    write_job(folder, cloud, skeleton, settings)
    job_runner.run_job(folder, send, CancelFlag())


class _PartialProgress:
    """Forwards a job's progress as a part of the progress of all jobs."""

    def __init__(self, send: Callable[[dict[str, Any]], None], start: float, share: float) -> None:
        self._send, self._start, self._share = send, start, share

    def __call__(self, line: dict[str, Any]) -> None:
        if line["stage"] != "done":
            fraction = round(self._start + self._share * line["fraction"], 4)
            self._send({"stage": _NAME, "fraction": fraction, "seconds_left": None, "message": line["message"]})


def _limb() -> tuple[SplatCloud, Skeleton, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Splats on a tube with two bones along x, and the tube's mesh: verts (V, 3), faces (F, 3)."""
    rng = np.random.default_rng(0)
    x, angle = rng.uniform(0, 2, _SPLATS), rng.uniform(0, 2 * np.pi, _SPLATS)
    cloud = SplatCloud(
        np.stack([x, 0.15 * np.cos(angle), 0.15 * np.sin(angle)], axis=1).astype(np.float32),
        rng.normal(size=(_SPLATS, 4)).astype(np.float32),
        np.full((_SPLATS, 3), 0.03, np.float32),
        np.full(_SPLATS, 0.9, np.float32),
        rng.normal(0, 0.3, (_SPLATS, 4, 3)).astype(np.float32),
    )
    heads = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    skeleton = Skeleton(("upper", "lower"), np.array([-1, 0]), heads, heads + (1.0, 0.0, 0.0))
    along, around = np.meshgrid(
        np.linspace(0, 2, _RINGS), np.linspace(0, 2 * np.pi, _SIDES, endpoint=False), indexing="ij"
    )
    verts = np.stack([along, 0.15 * np.cos(around), 0.15 * np.sin(around)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(_RINGS - 1), np.arange(_SIDES), indexing="ij")
    a, b = (i * _SIDES + j).ravel(), (i * _SIDES + (j + 1) % _SIDES).ravel()
    faces = np.concatenate([np.stack([a, a + _SIDES, b], 1), np.stack([b, a + _SIDES, b + _SIDES], 1)])
    return cloud, skeleton, verts, faces
