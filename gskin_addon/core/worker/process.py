# SPDX-License-Identifier: GPL-3.0-or-later
"""The program that runs a job: `python -u .../core/worker/process.py JOBDIR` with any Python that has torch.

It prints JSON lines: {"stage", "fraction" (0 to 1, of the whole job), "seconds_left" (or null), "elapsed",
"losses", "message"}; the last one is {"stage": "done", ...} or {"stage": "error", "error" (one sentence),
"plain" (it without flags and variables), "traceback", "exit_code"}. Closing a piped stdin, SIGTERM or SIGINT
cancels it. Exit codes: 0 done, 1 failure, 2 bad input, 130 cancelled. The same job started again goes on from its
last checkpoint.

`process.py --warm` compiles what jobs need into the user's cache instead; `process.py --draw` draws the frames that
come through its standard input (`frame_worker.py`).

Started by its path, it loads the package around it, wherever that lies and whatever its folder is called, and
leaves sys.path alone. Only syntax of old Pythons here, so that the check of the version can run.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import tempfile
from pathlib import Path

_NAME = "gskin_addon"


def main(arguments: list[str] | None = None) -> int:
    """Run `JOBDIR`, in a second process that this one watches over; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    warming, drawing = arguments == ["--warm"], arguments == ["--draw"]
    computing = warming or drawing or arguments[:1] == ["--compute"]
    folders = arguments[1:] if computing else arguments
    if not (warming or drawing) and (len(folders) != 1 or folders[0].startswith("-")):
        return _refuse("Usage: process.py JOBDIR (the folder of a job, see core/job/contract.py)")
    if sys.version_info < (3, 11):  # noqa: UP036  (whoever starts this may name any Python)
        version = ".".join(str(number) for number in sys.version_info[:3])
        return _refuse(
            f"The worker's interpreter '{sys.executable}' is Python {version}; name one of 3.11 or later "
            "in the add-on's preferences",
            " (or GSKIN_PYTHON)",
        )
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads must not take the artist's cores
    # numpy reads these when it loads. Its threads spin while they wait, and cost a job on small matrices several times
    # the core-seconds that they save; the job has threads of its own. torch ignores them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("VECLIB_MAXIMUM_THREADS", "1")
    os.environ.setdefault("NUMBA_CACHE_DIR", user_cache("numba"))
    os.environ.setdefault("WARP_CACHE_PATH", user_cache("warp"))
    package = load_package()
    if computing:
        if importlib.util.find_spec("numpy") is None:
            return _refuse(
                f"The worker's interpreter '{sys.executable}' lacks numpy; install with: "
                f"{sys.executable} -m pip install numpy scipy numba torch safetensors"
            )
        if drawing:
            return int(importlib.import_module(f"{package}.core.worker.frame_worker").main())
        if warming:
            return int(importlib.import_module(f"{package}.core.worker.warm").main())
        job_runner = importlib.import_module(f"{package}.core.worker.job_runner")
        return int(job_runner.main(folders[0]))
    supervisor = importlib.import_module(f"{package}.core.worker.supervisor")
    isolated = ["-I"] if sys.flags.isolated else []
    command = [sys.executable, *isolated, "-u", os.path.abspath(__file__), "--compute", folders[0]]
    return int(supervisor.supervise(command))


def load_package() -> str:
    """Import the package that this file lies in, by its folder; returns the name it is known by."""
    if __package__:
        return __package__.split(".")[0]
    here = Path(__file__).resolve()
    # Python put this file's folder first on the path; its module names are not meant for everybody.
    sys.path[:] = [entry for entry in sys.path if not entry or Path(entry).resolve() != here.parent]
    if _NAME not in sys.modules:
        root = here.parents[2]
        spec = importlib.util.spec_from_file_location(
            _NAME, root / "__init__.py", submodule_search_locations=[str(root)]
        )
        if spec is None or spec.loader is None:
            raise ImportError(f"no package in '{root}'")
        module = importlib.util.module_from_spec(spec)
        sys.modules[_NAME] = module
        spec.loader.exec_module(module)
    return _NAME


def user_cache(name: str) -> str:
    """A folder of the user where `name` keeps compiled kernels: the add-on's own may be read-only."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or os.path.expanduser("~")
    elif sys.platform == "darwin":
        base = os.path.expanduser("~/Library/Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = os.path.join(base, "gskin", name)
    try:
        os.makedirs(folder, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        print(f"'{folder}' cannot be made; compiled kernels are kept for this run only", file=sys.stderr)
    return tempfile.mkdtemp(prefix=f"gskin-{name}-")


def _refuse(sentence: str, shell: str = "") -> int:
    plain, full = sentence + ".", sentence + shell + "."
    error = {"stage": "error", "error": full, "plain": plain, "traceback": "", "exit_code": 2}
    print(json.dumps(error), flush=True)
    return 2


if __name__ == "__main__":
    sys.exit(main())
