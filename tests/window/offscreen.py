# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D view of bpy 5.3, drawn off screen by viewport.py and judged: for a Blender that no Debian has yet.

And frames of *Render Splats* by the shader (shader_frames.py).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from judging import COLOURS, FILLED, MOVED_SHARE, Check, print_checks
from looks import changed, look, read
from version_venv import Missing, make

ROOT = Path(__file__).resolve().parents[2]
VERSION = "5.3"
PACKAGES = ("xvfb", "xauth", "libgl1-mesa-dri", "libegl1")


def check_viewport(out: Path, splats: Path) -> list[Check] | str:
    """Draw and judge; a sentence instead where this machine cannot draw."""
    if problem := install_screen():
        return problem
    try:
        python = make(VERSION)
    except Missing as problem:
        return str(problem)
    command = ["xvfb-run", "-a", str(python), str(ROOT / "tests/window/viewport.py")]
    environment = {**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1", "PYTHONPATH": str(ROOT)}
    out.mkdir(parents=True, exist_ok=True)
    words = ["--out", str(out), "--splats", str(splats)]
    if subprocess.call([*command, *words], env=environment, cwd=ROOT, timeout=1200) != 0:
        return [(f"bpy {VERSION} draws its 3D view", False, "its words are above")]
    checks: list[Check] = []
    for name in ("empty", "rest", "posed"):
        seen = look(read(out / f"{name}.png"))
        good = seen.colours < COLOURS / 2 if name == "empty" else seen.filled > FILLED and seen.colours > COLOURS
        checks.append((f"bpy {VERSION}: {name}.png shows {'no' if name == 'empty' else 'the'} splats", good, str(seen)))
    share = changed(*(read(out / f"{name}.png") for name in ("rest", "posed")))
    checks.append((f"bpy {VERSION}: the picture changes with the pose", share > MOVED_SHARE, f"{share:.0%}"))
    command[-1] = str(ROOT / "tests/window/shader_frames.py")
    good = subprocess.call(command, env=environment, cwd=ROOT, timeout=600) == 0
    checks.append((f"bpy {VERSION}: Render Splats by the shader is the rasteriser's picture", good, "see above"))
    print_checks(checks)
    return checks


def install_screen() -> str:
    """'' where xvfb and Mesa are here or could be installed, else what to type."""
    def missing() -> bool:
        drivers = list(Path("/usr/lib").glob("*/dri/swrast_dri.so"))
        return shutil.which("xvfb-run") is None or not drivers

    if not missing():
        return ""
    line = ["apt-get", "install", "-qy", "--no-install-recommends", *PACKAGES]
    if shutil.which("apt-get") and os.geteuid() == 0:
        quiet = {"stdin": subprocess.DEVNULL, "stdout": sys.stderr}
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        subprocess.call(["apt-get", "update", "-q"], env=environment, **quiet)
        subprocess.call(line, env=environment, **quiet)
    return "a screen in memory is missing; type once: sudo " + " ".join(line) if missing() else ""
