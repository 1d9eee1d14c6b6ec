# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding a Python that has torch, and asking one what it has.

`find_worker_python` only looks at files, so menus may call it; `check_python` starts the interpreter.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from .runtime_folder import ready_python, runtime_folder

VARIABLE = "GSKIN_PYTHON"
NEEDED = ("numpy", "scipy", "numba", "torch", "safetensors")
OLDEST = (3, 11)

_QUESTION = """
import importlib, json, sys
found, broken = {}, {}
for name in sys.argv[1:]:
    try:
        found[name] = str(importlib.import_module(name).__version__)
    except ModuleNotFoundError:
        pass
    except Exception as error:
        broken[name] = str(error).splitlines()[0] if str(error) else type(error).__name__
cuda = bool("torch" in found and sys.modules["torch"].cuda.is_available())
print("gskin:" + json.dumps([list(sys.version_info[:3]), found, broken, cuda]))
"""


@dataclass(frozen=True)
class PythonReport:
    """What an interpreter has: its version, versions of modules by name, faults of broken ones, and CUDA."""

    python: Path
    version: tuple[int, ...] = ()
    found: dict[str, str] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)
    cuda: bool = False
    fault: str = ""
    needed: tuple[str, ...] = NEEDED

    @property
    def missing(self) -> list[str]:
        """Needed modules that are not installed."""
        return [name for name in self.needed if name not in self.found and name not in self.broken]

    @property
    def usable(self) -> bool:
        """Whether it can run a worker."""
        return not self.fault and not self.missing and not self.broken and self.version >= OLDEST

    @property
    def sentence(self) -> str:
        """One line for a person: what it has, or what is wrong and the remedy."""
        if self.fault:
            return self.fault
        if self.version < OLDEST:
            return f"'{self.python}' is Python {_dots(self.version)}; name one of {_dots(OLDEST)} or later."
        if self.broken:
            name, why = next(iter(self.broken.items()))
            return f"{name} of '{self.python}' does not load ({why}); install it again."
        if self.missing:
            lacks, install = " and ".join(self.missing), " ".join(self.missing)
            return f"'{self.python}' lacks {lacks}; install with: {self.python} -m pip install {install}"
        device = "CUDA" if self.cuda else "CPU"
        torch, numba = self.found["torch"], self.found["numba"]
        return f"Python {_dots(self.version)}, torch {torch} ({device}), numba {numba}"


def find_worker_python(preference: str = "") -> Path | None:
    """The interpreter that shall run jobs, or None.

    In this order: $GSKIN_PYTHON, `preference`, the learning runtime, this interpreter if it has torch, the active
    virtual or conda environment, python3 and python on the PATH. What is named explicitly is taken at its word.

    Raises:
        InputError: $GSKIN_PYTHON or `preference` names a file that is not there or cannot be run.
    """
    for origin, named in ((f"${VARIABLE}", os.environ.get(VARIABLE, "")), ("the preferences", preference)):
        if named.strip():
            return _named(named.strip(), origin)
    runtime = ready_python(runtime_folder())
    if runtime is not None:
        return runtime
    if (
        sys.executable
        and importlib.util.find_spec("torch") is not None
        and "python" in Path(sys.executable).name
    ):
        return Path(sys.executable)
    candidates = [
        _in_environment(Path(os.environ[name]))
        for name in ("VIRTUAL_ENV", "CONDA_PREFIX")
        if os.environ.get(name)
    ]
    candidates += [Path(found) for name in ("python3", "python") if (found := shutil.which(name))]
    return next((path for path in candidates if path.is_file() and has_torch(path)), None)


def has_torch(python: Path) -> bool:
    """Whether torch lies where `python` would look for installed packages; looks at files only."""
    # A virtual environment's python is a link to its base, but the packages are beside the link.
    for prefix in {python.parent.parent, python.resolve().parent.parent, python.parent}:
        for pattern in (
            "lib/python3*/site-packages/torch/version.py",
            "lib/python3*/dist-packages/torch/version.py",
            "local/lib/python3*/dist-packages/torch/version.py",
            "Lib/site-packages/torch/version.py",
        ):
            if next(prefix.glob(pattern), None) is not None:
                return True
    return False


def check_python(python: str | Path, timeout: float = 120.0, needed: tuple[str, ...] = NEEDED) -> PythonReport:
    """Start `python` once and import `needed`, what a worker needs; takes seconds. Never raises: see `fault`."""
    python = Path(python).expanduser()
    try:
        answer = subprocess.run(
            [str(python), "-c", _QUESTION, *needed],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout,
            env=worker_environment(),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except subprocess.TimeoutExpired:
        return PythonReport(python, fault=f"'{python}' did not answer within {timeout:.0f} s; try again.")
    except OSError as error:
        return PythonReport(
            python, fault=f"'{python}' cannot be started ({error.strerror}); name a Python interpreter."
        )
    line = next(
        (text for text in answer.stdout.decode(errors="replace").splitlines() if text[:6] == "gskin:"), ""
    )
    try:
        version, found, broken, cuda = json.loads(line[6:])
    except ValueError:
        return PythonReport(
            python, fault=f"'{python}' does not answer like Python; name a Python interpreter."
        )
    return PythonReport(python, tuple(version), found, broken, cuda, needed=needed)


def warm_up(python: str | Path) -> str:
    """Let `python` compile what jobs need, so that the first one starts at once; waits, up to minutes.

    Returns "" or one line on what went wrong; a job then compiles for itself. Ends when this process does.
    """
    command = [str(python), "-u", str(Path(__file__).with_name("process.py")), "--warm"]
    below = getattr(subprocess, "CREATE_NO_WINDOW", 0) | getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    try:
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=worker_environment(), creationflags=below,
        ) as process:  # fmt: skip
            lines = [] if process.stdout is None else process.stdout.read().decode(errors="replace").splitlines()
            code = process.wait()
    except OSError as error:
        return f"'{python}' cannot be started ({error.strerror})."
    if code == 0:
        return ""
    try:
        return str(json.loads(lines[-1])["error"])
    except (IndexError, KeyError, ValueError):
        return f"'{python}' ended with exit code {code} while it prepared."


class PythonChecks:
    """Answers of `check_python`, asked for in the background and remembered; reading never waits.

    An interpreter that can run jobs is warmed up next, once.
    """

    def __init__(self) -> None:
        self._reports: dict[str, PythonReport | None] = {}
        self._warm: dict[str, bool] = {}

    def ask(self, python: str | Path) -> None:
        """Start asking `python`, unless that is under way."""
        key = str(python)
        if key in self._reports and self._reports[key] is None:
            return
        self._reports[key] = None
        threading.Thread(target=self._answer, args=(key,), name="gskin-check", daemon=True).start()

    def known(self, python: str | Path) -> PythonReport | None:
        """The last answer of `python`, or None when there is none (yet)."""
        return self._reports.get(str(python))

    def asking(self, python: str | Path) -> bool:
        """Whether an answer is under way."""
        return str(python) in self._reports and self._reports[str(python)] is None

    def warming(self, python: str | Path) -> bool:
        """Whether the interpreter is compiling ahead at the moment."""
        return self._warm.get(str(python)) is False

    def _answer(self, key: str) -> None:
        report = self._reports[key] = check_python(key)
        if report.usable and key not in self._warm:
            self._warm[key] = False
            problem = warm_up(key)
            self._warm[key] = True
            if problem:
                print(f"GSkin: compiling ahead failed: {problem}", file=sys.stderr)


def worker_environment() -> dict[str, str]:
    """Our environment without what makes another Python take this one's library for its own."""
    hidden = {"PYTHONHOME", "PYTHONSTARTUP", "__PYVENV_LAUNCHER__"}
    return {name: value for name, value in os.environ.items() if name not in hidden}


def _named(path: str, origin: str) -> Path:
    python = Path(path).expanduser()
    if not python.is_file():
        found = shutil.which(path)
        if found is None:
            raise InputError(
                f"The worker's interpreter '{path}' ({origin}) does not exist; correct the path."
            )
        python = Path(found)
    if not os.access(python, os.X_OK):
        raise InputError(
            f"The worker's interpreter '{path}' ({origin}) cannot be run; name a Python program."
        )
    return python.absolute()


def _in_environment(folder: Path) -> Path:
    windows = folder / "Scripts" / "python.exe"
    if windows.is_file():
        return windows
    return folder / "python.exe" if os.name == "nt" else folder / "bin" / "python"


def _dots(version: tuple[int, ...]) -> str:
    return ".".join(str(number) for number in version)
