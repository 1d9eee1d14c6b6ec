# SPDX-License-Identifier: GPL-3.0-or-later
"""Making, completing and repairing the learning runtime: what the program runtime_setup.py does."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..errors import GSkinError, InputError
from ..files import disk_error, full_disk
from . import parent_watch
from .interpreter import check_python, worker_environment
from .runtime_children import NO_WINDOW, Children, LineSender
from .runtime_choice import NEWEST_PYTHON, TORCH, WHEELS, Choice, find_backend, parse_source
from .runtime_folder import (
    ENVIRONMENT,
    LOG,
    SCRATCH,
    delete,
    look,
    packages_in,
    python_in,
    require_ours,
    runtime_lock,
    write_manifest,
)
from .runtime_packages import damaged_packages, forget_package, versions
from .runtime_tools import Tools, explain_failure, find_tools

OLDEST = (3, 11)

# The part of the whole that each stage takes.
_SHARES = {
    "prepare": (0.0, 0.01),
    "environment": (0.01, 0.06),
    "torch": (0.06, 0.55),
    "packages": (0.55, 0.85),
    "check": (0.85, 0.9),
    "compile": (0.9, 1.0),
}
_MEGABYTE = 1e6


def main(arguments: Sequence[str] | None = None, tools: Callable[[Choice], Tools] | None = None) -> int:
    """Do what `arguments` say; returns the exit code (0 done, 1 failure, 2 bad input, 130 cancelled)."""
    options = _parser().parse_args(arguments)
    send = LineSender()
    children = Children(send)
    pipe = parent_watch.take_stdin()
    if pipe is not None:
        parent_watch.on_close(pipe, children.cancel)
    for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), children.on_signal)
    folder = Path(options.folder).expanduser().absolute()
    try:
        choice = Choice(find_backend(options.backend), options.diffusion, parse_source(options.source, options.place))
        message = Setup(folder, choice, tools or find_tools, send, children, repair=options.action == "repair").run()
    except (GSkinError, OSError) as error:
        problem = error if isinstance(error, GSkinError) else _disk_problem(error, folder)
        send({"stage": "error", "error": str(problem), "exit_code": problem.exit_code})
        return problem.exit_code
    send({"stage": "done", "fraction": 1.0, "message": message})
    return 0


class Setup:
    """One installation or repair of the runtime in `folder`."""

    def __init__(
        self,
        folder: Path,
        choice: Choice,
        tools: Callable[[Choice], Tools],
        send: Callable[[dict[str, Any]], None],
        children: Children,
        *,
        repair: bool = False,
    ) -> None:
        self.folder, self.choice, self.repair = folder, choice, repair
        self._tools_for, self._send, self._children = tools, send, children
        self._last = 0.0
        self._said: deque[str] = deque(maxlen=400)

    def run(self) -> str:
        """Bring the runtime to "ready"; returns a sentence.

        Raises:
            InputError: a folder, a Python or a choice that will not do. GSkinError: pip failed, or the check did.
        """
        begun = time.monotonic()
        self._say("prepare", 0, "Looking at the folder and the disk")
        before = look(self.folder)
        _check_python_version()
        require_ours(self.folder)
        self._check_room()
        tools = self._tools_for(self.choice)
        self._make_folder()
        with runtime_lock(self.folder):
            # From here on until the check nothing here passes for ready, whatever happens.
            self._write("installing", {})
            delete(self.folder / LOG)
            delete(self.folder / SCRATCH)
            (self.folder / SCRATCH).mkdir()
            old = before.choice
            if old is not None and old.backend != self.choice.backend:
                self._log(f"The backend was {old.backend.name}: making the environment anew")
                delete(self.folder / ENVIRONMENT)
            self._make_environment(tools)
            self._drop_damaged()
            self._install(tools, "torch", [TORCH])
            self._install(tools, "packages", list(self.choice.rest))
            state = self._check()
            state["tool"], state["seconds"] = tools.name, round(time.monotonic() - begun)
            delete(self.folder / SCRATCH)
            self._write("ready", state)
            if tools.warm:
                self._compile()
        return f"The learning runtime is ready: {look(self.folder).sentence}."

    def _check_room(self) -> None:
        """Raise InputError where the disk has less room than what is still to come."""
        there = _bytes_under(self.folder / ENVIRONMENT) / _MEGABYTE
        disk, fetched = self.choice.disk, self.choice.download
        fetched = 0 if self.choice.source.kind == WHEELS or there > 0.9 * disk else fetched
        needed = max(0.0, disk - there) + fetched
        place = self.folder
        while not place.exists() and place != place.parent:
            place = place.parent
        free = shutil.disk_usage(place).free / _MEGABYTE
        if free < needed:
            raise InputError(
                f"The learning runtime needs {needed / 1000:.1f} GB, but the disk of '{self.folder}' has "
                f"{free / 1000:.1f} GB free; free some, or choose another folder in the preferences."
            )

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.folder):
                pass
        except OSError as error:
            raise InputError(
                f"The folder '{self.folder}' cannot be written ({error.strerror}); "
                "change its permissions, or choose another one in the preferences."
            ) from error

    def _make_environment(self, tools: Tools) -> None:
        """Make the environment, or give it its Python back; one that works is kept with all its packages."""
        self._say("environment", 0, "Making an environment of its own")
        env, python = self.folder / ENVIRONMENT, python_in(self.folder)
        if self._answers(tools.alive(python)):
            return
        packages = packages_in(self.folder)
        if packages is not None and os.name != "nt" and packages.parent.name != _python_name():
            delete(env)  # packages of another version of Python are of no use
        elif os.name == "posix":
            for link in env.glob("bin/python*"):
                delete(link)  # venv keeps links, also dead ones
        code = self._run(tools.make(env), "environment")
        if code != 0 or not self._answers(tools.alive(python)):
            raise GSkinError(
                f"An environment could not be made in '{env}' by '{sys.executable}': {self._last_words()}; "
                "install python3-venv where Python is the system's, or name a Python yourself."
            )

    def _drop_damaged(self) -> None:
        """Forget packages with lost or cut files, so that the installation brings them again."""
        packages = packages_in(self.folder)
        if packages is None:
            raise GSkinError(f"The environment in '{self.folder}' has no folder of packages; remove it and try again.")
        for name, info in damaged_packages(packages, deep=self.repair).items():
            self._log(f"{name} is not whole: installing it again")
            forget_package(info)

    def _install(self, tools: Tools, stage: str, requirements: list[str]) -> None:
        """Install; what is there already stays.

        Raises:
            GSkinError: it failed, with the reason and the remedy.
        """
        flags = self.choice.source.flags(self.choice.backend, torch=stage == "torch")
        command = [*tools.install(python_in(self.folder)), *flags, *requirements]
        backend = self.choice.backend
        if stage == "torch":
            download, disk = backend.download, backend.disk
        else:
            download, disk = self.choice.download - backend.download, self.choice.disk - backend.disk
        self._say(stage, 0, f"Looking for {', '.join(requirements)[:60]}")
        with self._growth(stage, download * _MEGABYTE, disk * _MEGABYTE):
            code = self._run(command, stage)
        if code != 0:
            raise explain_failure("\n".join(self._said), self.choice, self._last_words())

    def _check(self) -> dict[str, Any]:
        """Import everything in the new environment; returns what the manifest keeps. Raises GSkinError."""
        self._say("check", 0, "Importing everything once")
        packages = packages_in(self.folder)
        lost = damaged_packages(packages) if packages is not None else {"all": Path()}
        if packages is None or lost:
            raise GSkinError(f"{next(iter(lost))} was not installed whole; repair the learning runtime.")
        report = check_python(python_in(self.folder), 600.0, self.choice.modules)
        if not report.usable:
            raise GSkinError(f"{report.sentence.rstrip('.')}: repair the learning runtime, or try another backend.")
        if self.choice.backend.name == "cuda" and not report.cuda:
            self._log("torch sees no CUDA device: jobs will run on the processor until the driver is updated")
        return {
            "packages": versions(packages, self.choice.names),
            "python": ".".join(str(number) for number in report.version),
            "base": os.path.realpath(sys.executable),
            "cuda": report.cuda,
            "megabytes": round(_bytes_under(self.folder / ENVIRONMENT) / _MEGABYTE),
        }

    def _compile(self) -> None:
        """Compile what jobs need; where that fails, the first job compiles for itself."""
        self._say("compile", 0, "Compiling for the first job")
        program = Path(__file__).with_name("process.py")
        if self._run([str(python_in(self.folder)), "-u", str(program), "--warm"], "compile") != 0:
            self._log(f"Compiling ahead failed ({self._last_words()}); the first job will do it")

    def _write(self, state: str, values: dict[str, Any]) -> None:
        choice = self.choice
        made = {"backend": choice.backend.name, "diffusion": choice.diffusion, "recipe": choice.recipe}
        write_manifest(self.folder, state, {**made, **values})

    def _answers(self, command: list[str]) -> bool:
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=120, env=_environment(self.folder),
                creationflags=NO_WINDOW, check=False,
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):  # it does not answer, which is the question
            return False
        return done.returncode == 0

    def _run(self, command: list[str], stage: str) -> int:
        """Run `command` to its end, its output into the log; returns the exit code. Raises GSkinError."""
        self._said.clear()
        try:
            return self._children.run(command, _environment(self.folder), lambda line: self._hear(line, stage))
        except OSError as error:
            raise GSkinError(f"'{command[0]}' cannot be started ({error.strerror}).") from error

    def _hear(self, line: str, stage: str) -> None:
        progress = _json_line(line)
        if progress is not None:  # of process.py --warm
            if progress.get("stage") == "error":
                self._said.append(str(progress.get("error")))
            else:
                self._say(stage, float(progress.get("fraction") or 0.0), "Compiling for the first job")
            return
        self._said.append(line)
        self._log(line)
        found = re.match(r"\s*(Collecting|Downloading|Using cached|Installing collected|Prepared|Installed)\b.*", line)
        if found:
            self._say(stage, None, re.sub(r"https?://\S+/", "", line.strip())[:90])

    def _log(self, line: str) -> None:
        with contextlib.suppress(OSError), open(self.folder / LOG, "a", encoding="utf-8") as file:
            file.write(line + "\n")  # the log is a courtesy; a full disk is met where it matters
        self._send({"stage": "log", "line": line})

    def _last_words(self) -> str:
        lines = [line.strip() for line in self._said if line.strip()]
        errors = [line for line in lines if re.match(r"(ERROR|error|Error|×|  ×)", line)]
        text = (errors or lines or ["it said nothing"])[-1]
        return re.sub(r"^(ERROR|error|Error): ?", "", text)[:200].rstrip(".")

    def _say(self, stage: str, share: float | None, message: str) -> None:
        """Tell how far it is: `share` 0 to 1 of the stage, None for as far as before. Never goes back."""
        if share is not None:
            start, end = _SHARES[stage]
            self._last = max(self._last, start + (end - start) * min(share, 1.0))
        self._send({"stage": stage, "fraction": round(self._last, 4), "message": message})

    @contextlib.contextmanager
    def _growth(self, stage: str, download: float, disk: float) -> Iterator[None]:
        """Tell the fraction of a stage from the bytes that appear: half for fetching, half for unpacking."""
        done = threading.Event()
        scratch, env = self.folder / SCRATCH, self.folder / ENVIRONMENT
        start = _bytes_under(env)

        def watch() -> None:
            most = 0
            while not done.wait(1.0):
                most = max(most, _bytes_under(scratch))
                grown = max(0, _bytes_under(env) - start)
                fetched = 1.0 if grown > 1e6 else min(1.0, most / download)
                self._say(stage, 0.5 * fetched + 0.5 * min(1.0, grown / disk), "")

        thread = threading.Thread(target=watch, name="gskin-growth", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def _check_python_version() -> None:
    version = sys.version_info[:2]
    if not OLDEST <= version <= NEWEST_PYTHON:
        raise InputError(
            f"'{sys.executable}' is Python {version[0]}.{version[1]}, and torch is there for "
            f"{OLDEST[0]}.{OLDEST[1]} to {NEWEST_PYTHON[0]}.{NEWEST_PYTHON[1]}; name another Python in the preferences."
        )


def _environment(folder: Path) -> dict[str, str]:
    """The surroundings of pip: unpack on the runtime's own disk, and install nowhere else than asked."""
    environment = worker_environment()
    for name in ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_USER", "PIP_REQUIREMENT", "VIRTUAL_ENV", "PYTHONPATH"):
        environment.pop(name, None)
    scratch = str(folder / SCRATCH)
    return environment | {"TMPDIR": scratch, "TEMP": scratch, "TMP": scratch, "PIP_USER": "0", "NO_COLOR": "1"}


def _disk_problem(error: OSError, folder: Path) -> GSkinError:
    if full_disk(error) is not None:
        return GSkinError(f"The disk of '{folder}' is full; free some space and install again, it goes on from here.")
    return disk_error(error, error.filename or folder)


def _bytes_under(folder: Path) -> int:
    """Bytes of the files under `folder`, which may be changing; 0 where it is missing."""
    total = 0
    for where, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # gone meanwhile
                total += os.lstat(os.path.join(where, name)).st_size
    return total


def _python_name() -> str:
    return f"python{sys.version_info[0]}.{sys.version_info[1]}"


def _json_line(line: str) -> dict[str, Any] | None:
    if not line.startswith("{"):
        return None
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) and "stage" in value else None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Make or repair gskin's learning runtime.", allow_abbrev=False)
    parser.add_argument("action", choices=("install", "repair"))
    parser.add_argument("--folder", required=True)
    parser.add_argument("--backend", required=True)
    parser.add_argument("--source", default="")
    parser.add_argument("--place", default="")
    parser.add_argument("--no-diffusion", dest="diffusion", action="store_false")
    return parser
