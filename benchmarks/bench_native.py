# SPDX-License-Identifier: GPL-3.0-or-later
"""What a posed frame costs as Blender's own splats (5.3 and later), beside the rig alone and the ellipsoids.

Processor milliseconds of all threads, so that other work on the machine does not count. Needs bpy 5.3.
Usage: python -m benchmarks.bench_native [SPLATS ...]
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from typing import Any

import bpy
import numpy as np

from benchmarks.bench_display import rigged
from gskin_addon.scene.display_inputs import NATIVE
from gskin_addon.scene.harmonics_nodes import MAX_DEGREE
from gskin_addon.scene.native_nodes import has_native_splats
from gskin_addon.scene.node_groups import find_display, set_display
from gskin_addon.scene.splat_object import read_cloud, replace_cloud

ROUNDS = 9
BARS = {0: 20.0, 3: 80.0}
"""Milliseconds that a frame of `BAR_SPLATS` may cost, by the degree of the harmonics, the rig with it."""
BAR_SPLATS = 120_000
WAYS = ("rig", "native", "ellipsoids")


def frame_costs(splats: int, degree: int, rounds: int = ROUNDS) -> dict[str, float]:
    """Median processor milliseconds of a posed frame of splats with harmonics of `degree`, by `WAYS`.

    "rig" is without a display; each of the others has the rig in it. The ways take turns.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    obj, armature = rigged(splats)
    harmonics = np.random.default_rng(0).normal(size=(splats, (degree + 1) ** 2, 3)).astype(np.float32)
    replace_cloud(obj, replace(read_cloud(obj), sh=harmonics))
    modifier: Any = find_display(obj)
    taken: dict[str, list[float]] = {way: [] for way in WAYS}
    for turn in range(rounds):
        for way in WAYS:
            modifier.show_viewport = way != "rig"
            set_display(obj, NATIVE, way == "native")
            bpy.context.view_layer.update()
            for step in range(3):
                armature.pose.bones[3].rotation_quaternion = (1, 0.1 + 0.03 * turn + 0.01 * step, 0, 0)
                began = time.process_time()
                bpy.context.view_layer.update()
                taken[way].append(1e3 * (time.process_time() - began))
    return {way: statistics.median(values) for way, values in taken.items()}


def main() -> None:
    """A line for each number of splats and degree; exit code 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("splats", type=int, nargs="*", default=[40_000, BAR_SPLATS, 150_000, 500_000])
    if not has_native_splats():
        raise SystemExit(f"Blender {bpy.app.version_string} draws no splats itself; use bpy 5.3 or later.")
    missed = False
    for splats in parser.parse_args().splats:
        for degree in range(MAX_DEGREE + 1):
            costs = frame_costs(splats, degree)
            words = ", ".join(f"{way} {cost:.1f}" for way, cost in costs.items())
            bar = BARS.get(degree) if splats == BAR_SPLATS else None
            if bar is not None:
                missed |= costs["native"] > bar
                words += f" (bar for native: {bar:g})"
            print(f"{splats:,} splats, degree {degree}: {words} ms", flush=True)
    raise SystemExit(int(missed))


if __name__ == "__main__":
    main()
