# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension without a window, in any Blender from 4.2: import, bind, pose against numpy, save and load.

blender -b --python-exit-code 1 --python tests/window/background.py -- --out DIR --splats FILE.ply
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from figure import TURNS, armature, distance_weights

ADDON = "bl_ext.user_default.gskin_addon"


def part(name: str) -> Any:
    """A module of the installed extension."""
    return importlib.import_module(f"{ADDON}.{name}")


def main() -> None:
    """Every step asserts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--splats", type=Path, required=True)
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :])
    assert ADDON in bpy.context.preferences.addons, "the extension is not on"
    bpy.ops.wm.read_homefile(use_empty=True)
    assert bpy.ops.gskin.import_splats(filepath=str(options.splats)) == {"FINISHED"}
    splats, rig = bpy.context.view_layer.objects.active, armature()
    cloud = part("scene.splat_object").read_cloud(splats)
    part("scene.weights").write_weights(splats, rig, distance_weights(cloud.means, rig), list(TURNS))
    learn(cloud, rig)
    part("scene.posing").turn_bones(rig, TURNS)
    compare(splats, "posed")
    path = options.out / "background.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    is_splats = part("scene.splat_object").is_splat_object
    splats = next(obj for obj in bpy.context.scene.objects if is_splats(obj))
    rig = next(obj for obj in bpy.context.scene.objects if obj.type == "ARMATURE")
    compare(splats, "loaded")
    part("scene.posing").turn_bones(rig, {"upper_arm": (0, 90, 0)})
    compare(splats, "posed again")
    module = importlib.import_module("addon_utils")
    module.disable(ADDON)
    assert not hasattr(bpy.types, "GSKIN_OT_auto_skin"), "unregistering left an operator"
    module.enable(ADDON)
    assert hasattr(bpy.types, "GSKIN_OT_auto_skin"), "registering again failed"
    python = "Python {}.{}".format(*sys.version_info)
    print(f"ok    {bpy.app.version_string}, {python}: import, bind, pose, save, load, off and on again")


def learn(cloud: Any, rig: Any) -> None:
    """The default weights in Blender's own Python, which has numpy and no more; said where they need more so far."""
    try:
        predict = part("core.skinning.learned.predict")
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "numba", "scipy"):
            raise
        print(f"skip  learned weights in Blender's own Python: {error}")
        return
    weights, _ = predict.learned_weights(cloud, part("scene.armature").read_skeleton(rig))
    assert weights.shape == (cloud.count, len(TURNS))
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-4
    head = cloud.means[:, 2] > 1.3
    column = part("scene.armature").read_skeleton(rig).names.index("head")
    assert weights[head, column].mean() > 0.8, "the head's splats do not follow the head"
    print(f"ok    learned weights in Blender's own Python, {cloud.count} splats")


def compare(splats: Any, when: str) -> None:
    """Positions and rotations as Blender evaluates them, against the rig's formulas in numpy."""
    display = part("scene.node_groups").find_display(splats)
    display.show_viewport = False
    mesh = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    drawn = part("scene.attributes").read_positions(mesh)
    turned = part("scene.attributes").read_attribute(mesh, part("scene.names").ROTATION)
    display.show_viewport = True
    wanted = part("scene.posing").posed_cloud(splats)
    size = np.linalg.norm(np.ptp(wanted.means, axis=0))
    off = np.abs(drawn - wanted.means).max() / size
    turned = turned.astype(np.float64) / np.linalg.norm(turned, axis=1, keepdims=True)
    signs = np.sign((turned * wanted.quats).sum(1, keepdims=True))
    angle = 4 * np.arcsin(np.linalg.norm(turned * signs - wanted.quats, axis=1) / 2).max()
    rest = part("scene.attributes").read_positions(splats.data)
    assert np.abs(drawn - rest).max() > 0.05 * size, f"{when}: nothing moved"
    assert off < 1e-5, f"{when}: {off} of the size away"
    assert angle < 1e-4, f"{when}: turned {angle} rad off"
    print(f"ok    {when}: positions {off:.1e} of the size, rotations {angle:.1e} rad")


main()
