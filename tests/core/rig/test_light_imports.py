# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own Python has numpy only: what its side of the house uses must import there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def test_rig_and_the_names_of_initial_weights_need_numpy_only():
    code = (
        "import sys\n"
        "for name in ('scipy', 'numba', 'torch', 'PIL', 'trimesh', 'safetensors'):\n"
        "    sys.modules[name] = None\n"
        "from gskin_addon.core.rig import anchoring, kinematics, lbs, mesh_weights, poses, quaternion, skeleton\n"
        "from gskin_addon.core.skinning.initial import INITIAL_WEIGHTS\n"
        "print(*INITIAL_WEIGHTS)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["learned", "visibility", "geodesic", "heat"]
