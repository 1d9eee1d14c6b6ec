# SPDX-License-Identifier: GPL-3.0-or-later
"""How soon Blender has splats, weights and a posed frame, and how long panels hold it up. Needs bpy.

Part of `make bench-speed`: python -m benchmarks.bench_speed --only scene
Processor seconds, as other work shares the machine.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

import gskin_addon
from benchmarks import bench_display
from benchmarks.figure import figure
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.scene.armature import deform_bone_names
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import read_weights, write_weights
from gskin_addon.session import learning_runtime, readiness


def import_seconds(splats: int = 100_000) -> float:
    """From a file with harmonics of degree 3 to an object that Blender has evaluated."""
    cloud = figure(splats, 5).cloud
    cloud = replace(cloud, sh=np.random.default_rng(0).normal(size=(splats, 16, 3)))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with tempfile.TemporaryDirectory(prefix="gskin-bench-") as folder:
        path = Path(folder) / "figure.ply"
        write_ply(path, cloud)

        def work() -> None:
            create_splat_object(read_ply(path).cloud, "S")
            bpy.context.view_layer.update()

        return _cost(work)


def rig_costs(splats: int = 100_000, rounds: int = 7) -> tuple[float, float, float]:
    """Seconds of writing weights, seconds of a posed frame without the display, and the frame with it over without."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    obj, armature = bench_display.rigged(splats, 50)
    weights, _ = read_weights(obj, deform_bone_names(armature))
    written = _cost(lambda: write_weights(obj, armature, weights))
    modifier = find_display(obj)
    taken: dict[bool, list[float]] = {False: [], True: []}
    for turn in range(rounds):
        for shown in (False, True):
            modifier.show_viewport = shown
            bpy.context.view_layer.update()
            armature.pose.bones[3].rotation_quaternion = (1, 0.1 + 0.03 * turn, 0, 0)
            taken[shown].append(_cost(bpy.context.view_layer.update))
    rig, drawn = (float(np.median(taken[shown])) for shown in (False, True))
    return written, rig, drawn / rig


def panel_seconds(splats: int = 150_000) -> tuple[float, float]:
    """One redraw's check list on many splats, and one look at the learning runtime's folder."""
    gskin_addon.register()
    try:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.gskin.splats = create_splat_object(figure(splats, 5).cloud, "S", display=False)
        readiness.checks(bpy.context)
        checks = _cost(lambda: [readiness.checks(bpy.context) for _ in range(10)]) / 10

        def look() -> None:
            learning_runtime.forget()
            learning_runtime.status(bpy.context)

        return checks, _cost(lambda: [look() for _ in range(20)]) / 20
    finally:
        gskin_addon.unregister()


def _cost(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began
