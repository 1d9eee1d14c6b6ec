# SPDX-License-Identifier: GPL-3.0-or-later
"""The learning runtime for real, from a package index: `make test-runtime`. Takes minutes and about 5 GB of disk.

Cancels in the middle and goes on, runs a small guided job in it, repairs it, fills a wheel folder and installs from it
alone, removes it. Prints seconds and megabytes as it goes; exit code 0 when everything held.

    INDEX=pip   packages as pip is configured (default); pytorch, or the address of an index
    PYTHON      the Python to build on (default: this one's base)
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

import worker_jobs as jobs  # noqa: E402

from gskin_addon.core.errors import Cancelled, GSkinError  # noqa: E402
from gskin_addon.core.job.contract import write_job  # noqa: E402
from gskin_addon.core.worker import runtime_folder as folders  # noqa: E402
from gskin_addon.core.worker.client import WorkerClient  # noqa: E402
from gskin_addon.core.worker.interpreter import find_worker_python, worker_environment  # noqa: E402
from gskin_addon.core.worker.runtime_choice import (  # noqa: E402
    MIRROR,
    PIP,
    PYTORCH,
    TORCH,
    WHEELS,
    Choice,
    find_backend,
    parse_source,
)
from gskin_addon.core.worker.runtime_client import RuntimeClient  # noqa: E402

SPLATS = 500


def main() -> int:
    """Run all steps; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--index", default=PIP, help="pip, pytorch, or the address of an index")
    parser.add_argument("--python", default=getattr(sys, "_base_executable", sys.executable))
    options = parser.parse_args()
    kind = options.index if options.index in (PIP, PYTORCH) else MIRROR
    choice = Choice(find_backend("cpu"), source=parse_source(kind, options.index))
    with tempfile.TemporaryDirectory(prefix="gskin runtime ü ") as scratch:
        folder, wheels = Path(scratch) / "runtime", Path(scratch) / "wheels"
        for name in ("GSKIN_PYTHON", "VIRTUAL_ENV"):
            os.environ.pop(name, None)
        os.environ[folders.VARIABLE] = str(folder)

        timed("cancel in the middle of the packages", cancel, folder, choice, options.python)
        timed("go on from there", install, "install", folder, choice, options.python)
        status = folders.look(folder)
        say(f"  {status.sentence}; made by {status.manifest['tool']}")
        assert status.state == "ready"
        timed(f"a guided job, draft, {SPLATS} splats", guided_job, Path(scratch) / "job")
        timed("install again, all is there", install, "install", folder, choice, options.python)

        packages = folders.packages_in(folder)
        assert packages is not None
        (packages / "numba" / "__init__.py").unlink()
        (packages / "torch" / "nn" / "functional.py").write_text("damaged")
        assert folders.look(folder).state == "broken"
        timed("repair numba and torch", install, "repair", folder, choice, options.python)
        assert folders.look(folder).state == "ready"

        timed("fill a wheel folder", download, wheels, choice)
        size = sum(path.stat().st_size for path in wheels.iterdir()) / 1e6
        say(f"  {len(list(wheels.iterdir()))} wheels, {size:,.0f} MB")
        timed("remove", folders.remove, folder)
        assert not folder.exists()
        offline = Choice(choice.backend, source=parse_source(WHEELS, str(wheels)))
        scipy = next(wheels.glob("scipy-*"))
        away, problem = scipy.rename(Path(scratch) / "away"), ""
        try:
            install("install", folder, offline, options.python)
        except GSkinError as error:
            problem = str(error)
        say(f"  without scipy's wheel: {problem}")
        assert "has no scipy" in problem
        assert not folders.look(folder).usable
        away.rename(scipy)
        timed("from the wheel folder alone", install, "install", folder, offline, options.python)
        assert find_worker_python() == folders.python_in(folder)
        timed("remove", folders.remove, folder)
    say("everything held")
    return 0


def timed(name: str, act: Callable[..., None], *arguments: Any) -> None:
    """Do it and say how long it took."""
    begun = time.monotonic()
    act(*arguments)
    say(f"{time.monotonic() - begun:7.1f} s  {name}")


def install(action: Literal["install", "repair"], folder: Path, choice: Choice, python: str) -> None:
    """Run to the end. Raises as the client."""
    client = RuntimeClient(action, folder, choice, python)
    client.start()
    stages: dict[str, float] = {}
    client.wait(lambda event: stages.setdefault(event.stage, time.monotonic()))
    names, ends = list(stages), [*stages.values(), time.monotonic()]
    parts = (f"{name} {end - begin:.0f} s" for name, begin, end in zip(names, ends, ends[1:], strict=False))
    say(f"  {', '.join(parts)}")


def cancel(folder: Path, choice: Choice, python: str) -> None:
    """Cancel while pip installs the second half."""
    client = RuntimeClient("install", folder, choice, python)
    client.start()
    while not (client.progress.stage == "packages" and client.progress.message.startswith("Installing")):
        client.poll()
        assert client.state == "running", client.sentence
        time.sleep(0.05)
    time.sleep(3.0)
    begun = time.monotonic()
    client.cancel()
    try:
        client.wait(interval=0.01)
    except Cancelled as error:
        say(f"  gone after {time.monotonic() - begun:.2f} s: {error}")
    assert client.state == "cancelled"
    assert time.monotonic() - begun < 1.0
    assert not folders.look(folder).usable


def guided_job(folder: Path) -> None:
    """Guidance and optimisation in the runtime that is found by itself."""
    cloud, skeleton = jobs.rod(SPLATS)
    write_job(folder, cloud, skeleton, {"preset": "draft", "guidance": "elastic"})
    python = find_worker_python()
    assert python is not None
    client = WorkerClient(python, folder)
    client.start()
    weights = client.wait().weights
    assert weights.shape == (SPLATS, 2)
    assert abs(weights.sum(1) - 1).max() < 1e-5


def download(wheels: Path, choice: Choice) -> None:
    """What a person with network does for one without (docs/install.md)."""
    python = folders.python_in(folders.runtime_folder())
    flags = choice.source.flags(choice.backend, torch=True)
    command = [str(python), "-m", "pip", "download", "-q", "--only-binary=:all:", "-d", str(wheels), *flags]
    subprocess.run([*command, TORCH, *choice.rest], check=True, env=worker_environment())


def say(text: str) -> None:
    """One line, at once."""
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
