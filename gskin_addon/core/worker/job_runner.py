# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker's inner process: reads a job, runs the pipeline, writes the result, and reports line by line."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from ..errors import Cancelled, GSkinError, InputError
from ..job.progress import CancelFlag, Progress
from . import parent_watch

if TYPE_CHECKING:
    from ..job.contract import Job
    from ..pipeline.result import SkinResult

MODULES = ("numpy",)
"""Modules that a worker's Python needs for a job that neither renders nor learns."""
RUNTIME_MODULES = ("numpy", "scipy", "numba", "torch", "safetensors")
"""Modules that it needs for the others; see `JobSettings.needs_runtime`."""

_LAST_RESORT = 2.0
"""Seconds after which a cancelled process ends whatever it is doing, should its supervisor be gone."""


Pipeline = Callable[[Any, Any, dict[str, Any], Progress, Path], "SkinResult"]


def main(folder: str | Path, pipeline: Pipeline | None = None) -> int:
    """Run the job in `folder` and return the exit code; JSON lines go to the real stdout, prints to stderr.

    `pipeline` is core/pipeline/run.py unless another is given.
    """
    send = take_stdout()
    cancelled = CancelFlag()
    if os.name == "posix":
        # These normally reach us through the supervisor, as a closed stdin.
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: cancelled.set())
        parent_watch.die_with_parent(signal.SIGKILL)
    pipe = parent_watch.take_stdin()
    if pipe is not None:
        parent_watch.on_close(pipe, lambda: _give_up(cancelled))
    try:
        run_job(Path(folder), send, cancelled, pipeline)
        return 0
    except Exception as error:
        code, sentence, details = explain(error)
        plain = getattr(error, "plain", sentence)
        send({"stage": "error", "error": sentence, "plain": plain, "traceback": details, "exit_code": code})
        return code


def run_job(
    folder: Path,
    send: Callable[[dict[str, Any]], None],
    cancelled: CancelFlag,
    pipeline: Pipeline | None = None,
) -> None:
    """Run the job in `folder`, reporting by `send`; exceptions pass through. A finished job is not run again. A stopped
    one continues from the pipeline's checkpoint.
    """
    progress = Progress(send, cancelled)
    progress("start", 0.0, {}, "Reading the job")
    from ..job.contract import LOCK, is_finished, read_job, write_result
    from ..job.lock import job_lock

    if not folder.is_dir():
        raise InputError(f"The job folder '{folder}' does not exist; write the job first.")
    with job_lock(folder / LOCK):
        job = read_job(folder)
        if not is_finished(folder):
            started = time.monotonic()
            if pipeline is None:
                pipeline = _load_pipeline(job, progress)
            job.checkpoint.mkdir(exist_ok=True)
            result = pipeline(job.cloud, job.skeleton, job.settings, progress, job.checkpoint)
            seconds = time.monotonic() - started
            progress("write", 1.0, {}, "Writing the weights", 0.0)
            report = {**result.report, "worker": {"seconds": round(seconds, 2), **_machine()}}
            more = result.mesh_weights, result.confidence, result.start
            write_result(job, result.weights, report, result.previews, *more)
    send({"stage": "done", "fraction": 1.0, "seconds_left": 0.0, "losses": {}, "message": "Done"})


def check_modules(modules: tuple[str, ...] = MODULES) -> None:
    """Raise InputError naming this interpreter, the modules that it lacks, and how to install them."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"The worker's interpreter '{sys.executable}' lacks {' and '.join(missing)}; install "
            f"with: {sys.executable} -m pip install {' '.join(missing)}"
            " - or name another interpreter in the add-on's preferences.",
            terminal="or GSKIN_PYTHON",
        )


def explain(error: BaseException) -> tuple[int, str, str]:
    """(exit code, one sentence for a person, traceback) of the exception that ended a job."""
    details = "".join(traceback.format_exception(error))
    if isinstance(error, GSkinError):
        return error.exit_code, str(error), "" if isinstance(error, (InputError, Cancelled)) else details
    if "numpy" in sys.modules:
        from ..files import disk_error, full_disk

        full = full_disk(error)
        if full is not None:
            return 1, str(disk_error(full)), details
    if isinstance(error, MemoryError) or "not enough memory" in str(error) or "out of memory" in str(error):
        return 1, "The memory ran out; use a lighter preset, fewer splats, or a larger machine.", details
    words = (str(error).strip().splitlines() or [""])[0]
    return 1, f"The worker failed with {type(error).__name__}: {words}"[:500], details


def _load_pipeline(job: Job, progress: Progress) -> Pipeline:
    from ..job.settings import JobSettings
    from ..pipeline.run import run

    if not JobSettings.parse(job.settings).needs_runtime:
        return run
    progress("start", 0.0, {}, "Loading torch")
    check_modules(RUNTIME_MODULES)
    try:
        import numba  # noqa: F401
        import torch  # noqa: F401
    except (ImportError, OSError) as error:
        raise InputError(
            f"The worker's interpreter '{sys.executable}' has a broken installation ({error}); install again "
            f"with: {sys.executable} -m pip install --force-reinstall torch numba"
        ) from error
    return run


def _machine() -> dict[str, Any]:
    facts: dict[str, Any] = {"python": sys.version.split()[0], "cores": os.cpu_count()}
    torch = sys.modules.get("torch")
    if torch is not None:
        facts["torch"] = str(torch.__version__)
    if sys.platform != "win32":
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        facts["peak_memory_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6)
    return facts


def _give_up(cancelled: CancelFlag) -> None:
    cancelled.set()
    time.sleep(_LAST_RESORT)
    os._exit(130)


def take_stdout() -> Callable[[dict[str, Any]], None]:
    """Keep stdout for the lines of the contract; whatever else is printed, also from C, goes to stderr."""
    sys.stdout.flush()
    channel: BinaryIO = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    sys.stdout = sys.stderr

    def send(line: dict[str, Any]) -> None:
        with contextlib.suppress(BrokenPipeError):  # the supervisor ends us when its reader is gone
            channel.write(json.dumps(line, allow_nan=False).encode() + b"\n")

    return send
