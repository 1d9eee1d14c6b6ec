# SPDX-License-Identifier: GPL-3.0-or-later
"""A Python that lacks some modules, as Blender's own does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def output_without(modules: tuple[str, ...], code: str) -> str:
    """What `code` prints in a new Python that cannot import `modules`; AssertionError with its words if it fails."""
    hide = f"import sys\nfor name in {modules!r}: sys.modules[name] = None\n"
    done = subprocess.run(
        [sys.executable, "-c", hide + code], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
