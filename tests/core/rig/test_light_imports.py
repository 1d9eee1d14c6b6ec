# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's own Python has numpy only: what its side of the house uses must import there."""

from __future__ import annotations

from without import output_without


def test_rig_and_the_names_of_initial_weights_need_numpy_only():
    code = (
        "from gskin_addon.core.rig import anchoring, kinematics, lbs, mesh_weights, poses, quaternion, skeleton\n"
        "from gskin_addon.core.skinning.initial import INITIAL_WEIGHTS\n"
        "print(*INITIAL_WEIGHTS)\n"
    )
    heavy = ("scipy", "numba", "torch", "PIL", "trimesh", "safetensors")
    assert output_without(heavy, code).split() == ["learned", "visibility", "geodesic", "heat"]
