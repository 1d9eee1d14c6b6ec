# SPDX-License-Identifier: GPL-3.0-or-later
"""A small environment with one version of Blender's `bpy` module and what the tests need; no torch. Asks nothing.

    python3 tools/version_venv.py 5.3 [--folder .venvs]

What is in it is what Blender's own Python has (numpy), so that an import of anything else in Blender's process is
found out. Made once, and again when this file or the interpreter changes.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import make_venv
from make_venv import ROOT, say

FOLDER = ROOT / ".venvs"
PYTHONS = {"4.5": (3, 11), "5.0": (3, 11), "5.2": (3, 13), "5.3": (3, 13)}
"""Versions of the module that the package index has, and the Python each is built for."""
PACKAGES = ("pytest>=8", "pytest-timeout>=2", "hypothesis>=6", "plyfile>=1")


class Missing(Exception):
    """An environment cannot be made; the message is one sentence that says what to do."""


def main() -> int:
    """Make the environments that are named; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("versions", nargs="+", choices=PYTHONS, metavar="VERSION", help=", ".join(PYTHONS))
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where environments are (default: .venvs)")
    options = parser.parse_args()
    for version in options.versions:
        try:
            print(make(version, options.folder))
        except Missing as problem:
            return make_venv.fail(str(problem))
    return 0


def make(version: str, folder: Path = FOLDER) -> Path:
    """The interpreter of the environment for a version of Blender, made where it is not; raises Missing."""
    python = find_python(PYTHONS[version])
    if problem := make_venv.install_system_libraries():
        raise Missing(problem)
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder / f"bpy-{version}.lock"):
        return _make(version, python, folder.absolute() / f"bpy-{version}")


@contextlib.contextmanager
def alone(lock: Path) -> Iterator[None]:
    """Wait until no other process makes the same environment, where the system has such locks."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield


def _make(version: str, python: str, venv: Path) -> Path:
    packages = [f"bpy=={version}.*", *PACKAGES]
    stamp, own = venv / "gskin-setup.sha256", make_venv.venv_python(venv)
    state = hashlib.sha256(repr((packages, python, str(venv), str(ROOT))).encode()).hexdigest()
    if stamp.is_file() and stamp.read_text() == state:
        return own
    say(f"making {venv} with {python}", sys.stderr)
    if subprocess.call([python, "-m", "venv", "--clear", str(venv)]) != 0:
        raise Missing(f"The environment {venv} could not be made: install the venv package of {python}.")
    if subprocess.call([str(own), "-m", "pip", "install", "--no-input", "--quiet", *packages]) != 0:
        raise Missing(f"pip could not install {' '.join(packages)}: its last lines above say why.")
    # The project as an editable install has it: workers are started without PYTHONPATH.
    where = subprocess.check_output(
        [str(own), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True
    ).strip()
    (Path(where) / "gskin_addon.pth").write_text(f"{ROOT}\n")
    if subprocess.call([str(own), "-c", "import bpy, gskin_addon"]) != 0:
        raise Missing(f"bpy {version} was installed but does not import; the lines above say why.")
    stamp.write_text(state)
    return own


def find_python(wanted: tuple[int, int]) -> str:
    """An interpreter of that version: $PYTHON, this one, one on PATH, or one of pyenv's; raises Missing."""
    name = "python{}.{}".format(*wanted)
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [os.environ.get("PYTHON"), sys.executable, shutil.which(name)]
    candidates += [str(path) for path in sorted(pyenv.glob(f"*/bin/{name}"))]
    for candidate in candidates:
        if candidate and make_venv.interpreter_version(candidate) == wanted:
            return base_of(candidate)
    raise Missing(
        f"No {name} was found, which this version of Blender's bpy module needs: install {name} and {name}-venv."
    )


def base_of(python: str) -> str:
    """The interpreter that an environment's was made from: environments are not built on one another."""
    code = "import os, sys; print(os.path.realpath(getattr(sys, '_base_executable', sys.executable)))"
    return subprocess.check_output([python, "-c", code], text=True).strip()


if __name__ == "__main__":
    sys.exit(main())
