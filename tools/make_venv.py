# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the virtual environment with everything that gskin needs; asks nothing; run again only when needed.

    python3 tools/make_venv.py [--venv .venv]

Runs under any Python >= 3.8 and uses the standard library only. The environment itself needs CPython 3.11 or
3.13, the two versions that Blender publishes its `bpy` module for.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TextIO

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = "worker,blender,mesh,diffusion,bench,dev"
TORCH = "torch==2.13.0"
BLENDER_MODULE = {(3, 11): "bpy>=5.0,<5.1", (3, 13): "bpy>=5.1,<5.3"}

# The shared libraries that `import bpy` opens on Linux, and the Debian packages that carry them.
SYSTEM_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libGL.so.1": "libgl1",
}


def main() -> int:
    """Bring the environment up to date; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv", help="folder of the environment")
    venv = parser.parse_args().venv.absolute()

    python = find_python(venv)
    if python is None:
        return fail(
            "No Python 3.11 or 3.13 was found, which Blender's bpy module needs: install python3.11 and "
            "python3.11-venv, or name an interpreter with PYTHON=/path/to/python3.11."
        )
    problem = install_system_libraries()
    if problem:
        return fail(problem)
    fingerprint = wanted_state(python)
    stamp = venv / "gskin-setup.sha256"
    if stamp.is_file() and stamp.read_text() == fingerprint:
        stamp.touch()
        return 0

    say(f"making {venv} with {python}")
    own = str(venv_python(venv))
    usable = interpreter_version(own) == interpreter_version(python) and runs([own, "-m", "pip", "--version"])
    if not usable and subprocess.call([python, "-m", "venv", "--clear", str(venv)]) != 0:
        return fail(
            f"The environment {venv} could not be made: install the venv package of {python} "
            "(on Debian: apt-get install python3-venv)."
        )
    pip = [own, "-m", "pip", "install", "--no-input", "--quiet"]
    # torch comes first and alone: it is by far the largest download, and a later step then never replaces it.
    steps = [[TORCH], [BLENDER_MODULE[interpreter_version(python)], "-e", f"{ROOT}[{EXTRAS}]"]]
    for packages in steps:
        say("installing " + " ".join(packages))
        if subprocess.call([*pip, *packages], cwd=ROOT) != 0:
            return fail(f"pip could not install {' '.join(packages)}: its last lines above say why.")
    if subprocess.call([own, "-c", "import bpy, torch, numba, gskin_addon"], cwd=ROOT) != 0:
        return fail(
            "The environment was installed but does not import; the lines above say which part is missing."
        )
    say("compiling the kernels of jobs, once")
    worker = ROOT / "gskin_addon" / "core" / "worker" / "process.py"
    if subprocess.call([own, str(worker), "--warm"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL) != 0:
        say("that failed; the first job will compile them, or say why it cannot")
    stamp.write_text(fingerprint)
    say("ready")
    return 0


def find_python(venv: Path) -> str | None:
    """The interpreter for the environment: $PYTHON, this one, the environment's own, or one on PATH."""
    own = venv_python(venv)
    candidates = [
        os.environ.get("PYTHON"),
        sys.executable,
        str(own) if own.exists() else None,
        shutil.which("python3.11"),
        shutil.which("python3.13"),
    ]
    for candidate in candidates:
        if candidate and interpreter_version(candidate) in BLENDER_MODULE:
            return candidate
    return None


def interpreter_version(python: str) -> tuple[int, int] | None:
    """(major, minor) of an interpreter, None when it does not run."""
    code = "import sys; print(*sys.version_info[:2])"
    try:
        out = subprocess.run(
            [python, "-c", code], capture_output=True, text=True, timeout=60, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    major, minor = out.split()
    return int(major), int(minor)


def install_system_libraries() -> str | None:
    """Install what `import bpy` needs through apt where allowed; else a sentence with what to type."""
    if platform.system() != "Linux":
        return None
    missing = missing_packages()
    if not missing:
        return None
    line = "apt-get install -y --no-install-recommends " + " ".join(missing)
    advice = f"Blender's module needs system libraries that are missing; type once: sudo {line}"
    apt = shutil.which("apt-get")
    prefix: list[str] = []
    if apt is None:
        return f"Blender's module needs system libraries, by Debian's names: {', '.join(missing)}."
    if os.geteuid() != 0:
        if not (shutil.which("sudo") and runs(["sudo", "-n", "true"])):
            return advice
        prefix = ["sudo", "-n"]
    say("installing system libraries: " + " ".join(missing))
    environment = ["env", "DEBIAN_FRONTEND=noninteractive"]
    quiet = ["-qq", "-o", "Dpkg::Use-Pty=0"]
    # The package lists of a minimal system are empty or stale, so they are read first; a failure there is not
    # final, because the lists at hand may be enough.
    subprocess.call([*prefix, *environment, apt, "update", *quiet], stdin=subprocess.DEVNULL)
    command = [*prefix, *environment, apt, "install", "-y", "--no-install-recommends", *quiet, *missing]
    if subprocess.call(command, stdin=subprocess.DEVNULL) != 0 or missing_packages():
        return advice
    return None


def missing_packages() -> list[str]:
    """Debian packages whose library cannot be opened; a new process sees what was installed meanwhile."""
    code = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"
    return [
        package
        for library, package in SYSTEM_LIBRARIES.items()
        if not _opens(library) and not runs([sys.executable, "-c", code, library])
    ]


def _opens(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def wanted_state(python: str) -> str:
    """A digest of all that decides what is installed."""
    digest = hashlib.sha256()
    for part in (
        (ROOT / "pyproject.toml").read_bytes(),
        Path(__file__).read_bytes(),
        str(ROOT).encode(),
        repr(interpreter_version(python)).encode(),
    ):
        digest.update(part)
    return digest.hexdigest()


def venv_python(venv: Path) -> Path:
    """The interpreter of an environment."""
    return venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def runs(command: list[str]) -> bool:
    """Whether a command exists and exits 0."""
    try:
        return (
            subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False).returncode
            == 0
        )
    except OSError:
        return False


def say(message: str, stream: TextIO | None = None) -> None:
    """One line for the person who waits."""
    print(f"set-up: {message}", file=stream, flush=True)


def fail(message: str) -> int:
    """One sentence on stderr; exit code 1."""
    print(message, file=sys.stderr, flush=True)
    return 1


if __name__ == "__main__":
    sys.exit(main())
