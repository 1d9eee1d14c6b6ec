# SPDX-License-Identifier: GPL-3.0-or-later
"""Real Blenders to test in: the one that $BLENDER names, else those of Debian, made once in build/blender-SUITE."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEBIAN = ROOT / "tools" / "debian_blender.sh"
SUITES = ("trixie", "sid")
"""Debian's trixie has Blender 4.3, sid 5.2."""


class Blender:
    """A Blender program: on this machine, or in a Debian of its own. name: for files and people."""

    def __init__(self, name: str, program: str, debian: Path | None) -> None:
        self.name, self.program, self.debian = name, program, debian

    def run(
        self, words: list[str], environment: dict[str, str], timeout: float, folders: Sequence[Path] = ()
    ) -> int:
        """Run a command where Blender is, which sees the project and `folders`; returns its exit code."""
        if self.debian is None:
            return subprocess.call(words, env={**os.environ, **environment}, timeout=timeout, cwd=ROOT)
        command = [str(DEBIAN), "run", str(self.debian)]
        for path in [*self._shown(), *(folder for folder in folders if folder.is_dir())]:
            command += ["-b", str(path)]
        command += ["--", *(f"{name}={value}" for name, value in environment.items()), *words]
        return subprocess.call(command, timeout=timeout, cwd=ROOT)

    def _shown(self) -> list[Path]:
        # The project, the environment and the Python that it is built on, each at its own place.
        places = [ROOT]
        for place in (Path(sys.prefix), Path(sys.base_prefix)):
            if place != Path("/usr") and not any(place.is_relative_to(other) for other in places):
                places.append(place)
        return places


def find_blenders(suites: list[str]) -> list[Blender]:
    """$BLENDER, or Debian's of these suites (all where none is named); SystemExit where one cannot be had."""
    named = os.environ.get("BLENDER", "")
    if named:
        for program in (named, "xvfb-run", "xdotool", "import"):
            if shutil.which(program) is None:
                raise SystemExit(f"'{program}' cannot be run; BLENDER= needs xvfb, xdotool and imagemagick here.")
        return [Blender("own", named, None)]
    found = []
    for suite in suites or SUITES:
        debian = ROOT / "build" / f"blender-{suite}"
        if subprocess.call([str(DEBIAN), "setup", suite, str(debian)]) != 0:
            raise SystemExit(2)
        found.append(Blender(suite, "blender", debian))
    return found
