# SPDX-License-Identifier: GPL-3.0-or-later
"""A worker whose pipeline does what settings["act"] or $GSKIN_TEST_ACT says; else it is core/worker/process.py."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from gskin_addon.core.job.mesh_files import read_mesh
from gskin_addon.core.rig.influences import Influences
from gskin_addon.core.worker import job_runner, supervisor


def act(cloud: Any, skeleton: Any, settings: dict[str, Any], progress: Any, checkpoint: Path) -> Any:
    what = settings.get("act") or os.environ.get("GSKIN_TEST_ACT", "finish")
    (checkpoint / "pid").write_text(str(os.getpid()))
    if what == "deaf":  # holds Python's lock for minutes, as a long compiled call does
        import numba

        @numba.njit
        def spin(count: int) -> float:
            total = 0.0
            for i in range(count):
                total += np.sin(total + i)
            return total

        spin(10)
        progress("deaf", 0.1, {}, "")
        spin(20_000_000_000)
    if what == "talk":
        for step in range(1_000_000):
            progress("talk", step / 1_000_000, {"l1": 1.0 / (step + 1)}, f"step {step}")
            time.sleep(0.01)
    if what == "raise":
        raise RuntimeError("the middle of the matter")
    if what == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == "vanish":
        os._exit(3)
    if what == "resume":  # ten steps, kept one by one; the first run stays at the fifth until it is stopped or let go
        kept = checkpoint / "step"
        first = int(kept.read_text()) if kept.exists() else 0
        for step in range(first, 10):
            kept.with_suffix(".tmp").write_text(str(step + 1))
            os.replace(kept.with_suffix(".tmp"), kept)
            progress("step", step / 10, {}, str(step))
            while first == 0 and step == 4 and not (checkpoint / "go_on").exists():
                time.sleep(0.01)
                progress("step", step / 10, {}, str(step))
        settings = {"first": first}
    weights = np.zeros((cloud.count, skeleton.count), np.float32)
    weights[:, 0] = 1.0
    start = None
    if what == "heights":  # from bone 0 to bone 1 along the last tenth below and the first above bone 1's head
        share = np.clip((cloud.means[:, 2] - skeleton.heads[1, 2]) / 0.2 + 0.5, 0, 1)
        weights[:, 0], weights[:, 1] = 1 - share, share
        half = np.full((cloud.count, 2), 0.5, np.float32)
        start = Influences(np.zeros_like(half, np.int32) + [0, 1], half)
    print("chatter on stdout")
    os.system("echo chatter of a child")
    progress("steps", 0.5, {"l1": 0.25, "bad": float("nan")}, "half")
    report = {"start": "bone heat", "settings": settings, "loss": np.float32(0.5), "curve": np.array([1.0, np.inf])}
    previews = {"rest": np.full((4, 6, 3), 0.5)}
    on_mesh = None
    if settings.get("mesh"):
        on_mesh = np.zeros((len(read_mesh(checkpoint.parent / settings["mesh"])[0]), skeleton.count), np.float32)
        on_mesh[:, 0] = 1.0
    return SimpleNamespace(
        weights=weights, report=report, previews=previews, mesh_weights=on_mesh, confidence=None, start=start
    )


def main() -> int:
    if sys.argv[1] == "--compute":
        return job_runner.main(sys.argv[2], act)
    return supervisor.supervise([sys.executable, "-u", __file__, "--compute", sys.argv[1]])


if __name__ == "__main__":
    sys.exit(main())
