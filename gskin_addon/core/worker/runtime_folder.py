# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the learning runtime lies, what its manifest says, whether it is whole, and its removal.

FOLDER/runtime.json   the manifest: state, choice, versions
FOLDER/env/           the environment
FOLDER/tmp/           unpacking; empty but while installing
FOLDER/install.log    what pip said last
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ..errors import GSkinError, InputError
from ..files import write_json
from ..job.lock import job_lock
from .runtime_choice import BACKENDS, Choice

VARIABLE = "GSKIN_RUNTIME"
MANIFEST, LOG, ENVIRONMENT, SCRATCH = "runtime.json", "install.log", "env", "tmp"
_LOCK = "runtime.lock"
_PROGRAM = "gskin learning runtime"

State = Literal["missing", "installing", "removing", "broken", "outdated", "ready"]


def runtime_folder(preference: str = "") -> Path:
    """$GSKIN_RUNTIME, else `preference`, else a folder of the user's that carries no version of Blender."""
    named = os.environ.get(VARIABLE, "").strip() or preference.strip()
    if named:
        return Path(named).expanduser().absolute()
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or os.path.expanduser("~/AppData/Local")
    elif sys.platform == "darwin":
        base = os.path.expanduser("~/Library/Application Support")
    else:
        base = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")
    return Path(base) / "gskin" / "runtime"


@dataclass(frozen=True)
class RuntimeStatus:
    """How the runtime in `folder` is; `problem` is a sentence with the remedy unless it is ready."""

    state: State
    folder: Path
    problem: str = ""
    manifest: dict[str, Any] = field(default_factory=dict)

    @property
    def usable(self) -> bool:
        """Whether jobs may run in it; an outdated one still works."""
        return self.state in ("ready", "outdated")

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return python_in(self.folder)

    @property
    def choice(self) -> Choice | None:
        """The backend and the packages that it was made with, where the manifest says so."""
        backend = BACKENDS.get(str(self.manifest.get("backend")))
        return None if backend is None else Choice(backend, bool(self.manifest.get("diffusion", True)))

    @property
    def sentence(self) -> str:
        """One line for a person."""
        if self.state != "ready":
            return self.problem
        versions = self.manifest.get("packages", {})
        backend = BACKENDS.get(str(self.manifest.get("backend")))
        name = "unknown backend" if backend is None else backend.title
        size = self.manifest.get("megabytes", 0)
        return f"torch {versions.get('torch', '?')} ({name}), Python {self.manifest.get('python', '?')}, {size:,} MB"


def look(folder: Path) -> RuntimeStatus:
    """The state of the runtime in `folder`. Looks at a few files only, so menus may call it."""
    path = folder / MANIFEST
    if not path.exists():
        return RuntimeStatus("missing", folder, "The learning runtime is not installed yet.")
    manifest = _read(folder)
    if manifest is None:
        return RuntimeStatus("broken", folder, f"'{path}' cannot be read; repair the learning runtime.")
    if manifest.get("program") != _PROGRAM:
        return RuntimeStatus("broken", folder, f"'{path}' is not gskin's; choose another folder for the runtime.")
    if manifest.get("state") != "ready":
        if _held(folder):
            if manifest.get("state") == "removing":
                return RuntimeStatus("removing", folder, "The learning runtime is being removed.", manifest)
            return RuntimeStatus("installing", folder, "The learning runtime is being installed.", manifest)
        return RuntimeStatus(
            "broken", folder, "The learning runtime is not complete; install it again to go on.", manifest
        )
    problem = _damage(folder, manifest)
    if problem:
        return RuntimeStatus("broken", folder, f"The learning runtime is damaged ({problem}); repair it.", manifest)
    status = RuntimeStatus("ready", folder, "", manifest)
    choice = status.choice
    if choice is None or choice.recipe != manifest.get("recipe"):
        return RuntimeStatus(
            "outdated", folder, "The learning runtime is of another version of gskin; it works, update it.", manifest
        )
    return status


def ready_python(folder: Path) -> Path | None:
    """The interpreter of the runtime in `folder`, where jobs may run in it."""
    status = look(folder)
    return status.python if status.usable else None


def write_manifest(folder: Path, state: str, values: dict[str, Any]) -> None:
    """Write runtime.json whole or not at all. Raises GSkinError where it cannot be written."""
    write_json(folder / MANIFEST, {"program": _PROGRAM, "format": 1, "state": state, **values})


def require_ours(folder: Path) -> None:
    """Raise InputError where `folder` holds anything that no runtime of ours put there."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"'{folder}' is a file; choose a folder for the learning runtime.")
    if not folder.is_dir():
        return
    try:
        names = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise InputError(f"The folder '{folder}' cannot be read ({error.strerror}); choose another one.") from error
    if MANIFEST in names:
        manifest = _read(folder)
        foreign = isinstance(manifest, dict) and manifest.get("program") != _PROGRAM
    else:
        foreign = bool(names - {_LOCK})
    if foreign:
        raise InputError(
            f"The folder '{folder}' holds other files; choose an empty or a new one for the learning runtime."
        )


def remove(folder: Path) -> None:
    """Delete the runtime in `folder`: what an installation makes there and the folder itself once empty.

    Takes seconds to minutes, for there are tens of thousands of files.

    Raises:
        InputError: there is none of ours there, or it is being installed. GSkinError: files that cannot be deleted.
    """
    give_up(folder)
    with runtime_lock(folder):
        for name in (ENVIRONMENT, SCRATCH, LOG, MANIFEST):
            delete(folder / name)
    with contextlib.suppress(OSError):  # another file of the person's keeps the folder
        (folder / _LOCK).unlink(missing_ok=True)
        folder.rmdir()


def give_up(folder: Path) -> None:
    """Mark the runtime in `folder` for removal: no job takes it from now on. Raises as `remove`."""
    manifest = _read(folder)
    if manifest is None or manifest.get("program") != _PROGRAM:
        raise InputError(f"There is no learning runtime of gskin's in '{folder}'; nothing was deleted.")
    with runtime_lock(folder):
        write_manifest(folder, "removing", {})


def delete(path: Path) -> None:
    """Delete a file or a folder; a link goes, not what it points to. Raises GSkinError."""
    try:
        if path.is_symlink() or path.is_file():
            path.unlink()
        elif path.exists():
            shutil.rmtree(path)
    except OSError as error:
        raise GSkinError(
            f"'{error.filename or path}' cannot be deleted ({error.strerror}); end what uses it and try again."
        ) from error


@contextlib.contextmanager
def runtime_lock(folder: Path) -> Iterator[None]:
    """Hold the runtime inside the block.

    Raises:
        InputError: another process installs it. GSkinError: the folder cannot be written.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(job_lock(folder / _LOCK, patience=0.5))
        except InputError as error:
            raise InputError(
                f"The learning runtime in '{folder}' is being installed by another process; wait for it, or cancel it."
            ) from error
        yield


def python_in(folder: Path) -> Path:
    """The interpreter of the environment in the runtime `folder`."""
    return folder / ENVIRONMENT / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def packages_in(folder: Path) -> Path | None:
    """The site-packages of the environment in the runtime `folder`, where there is one."""
    pattern = "Lib/site-packages" if os.name == "nt" else "lib/python3*/site-packages"
    return next((folder / ENVIRONMENT).glob(pattern), None)


def _read(folder: Path) -> dict[str, Any] | None:
    """The manifest, or None where it is damaged or cannot be read."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) else None


def _held(folder: Path) -> bool:
    try:
        with job_lock(folder / _LOCK, patience=0.0):
            return False
    except InputError:
        return True
    except GSkinError:  # a folder that cannot be written is not being installed into
        return False


def _damage(folder: Path, manifest: dict[str, Any]) -> str:
    """What a look at a few files finds wrong, or nothing."""
    if not python_in(folder).is_file():
        return "the Python that it was made with is gone"
    home = _home(folder)
    if home is None or not home.is_dir():
        return "the Python that it was made with is gone"
    packages = packages_in(folder)
    if packages is None:
        return "its packages are gone"
    choice = RuntimeStatus("ready", folder, "", manifest).choice
    for name in () if choice is None else choice.modules:
        if not (packages / name / "__init__.py").is_file():
            return f"{name} is gone"
    return ""


def _home(folder: Path) -> Path | None:
    """The folder of the Python that the environment builds on (pyvenv.cfg)."""
    try:
        lines = (folder / ENVIRONMENT / "pyvenv.cfg").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):  # reported as damage
        return None
    pairs = (line.partition("=") for line in lines)
    return next((Path(value.strip()) for key, _, value in pairs if key.strip() == "home"), None)
