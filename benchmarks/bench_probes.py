# SPDX-License-Identifier: GPL-3.0-or-later
"""What a pose costs where more than one armature moves splats, without the display. Needs bpy.

python -m benchmarks.bench_probes [--blend FILE]; processor seconds, as other work shares the machine.
--blend: a rigged file with one splat object (default: random weights of 50 bones, of which each splat has four).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from benchmarks import bench_display
from gskin_addon.scene import rig_files
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.probes import follow_stack, probes_of

ROUNDS = 9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blend", type=Path)
    parser.add_argument("--splats", type=int, default=152_000)
    options = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if options.blend is None:
        splats, body = bench_display.rigged(options.splats, 50)
    else:
        rig_files.open_blend(options.blend)
        splats = rig_files.find_splats(options.blend, None)
        body = armature_of(splats)
    find_display(splats).show_viewport = False
    print(f"{len(splats.data.vertices)} splats, {len(body.data.bones)} bones")
    print(f"one armature: {pose_seconds([body]) * 1000:.0f} ms")
    prop = body.copy()
    bpy.context.scene.collection.objects.link(prop)
    prop.animation_data_clear()
    second: Any = splats.modifiers.new("Second", "ARMATURE")
    second.object = prop
    splats.modifiers.move(len(splats.modifiers) - 1, 1)
    print(f"two, turned by the first alone: {pose_seconds([body, prop]) * 1000:.0f} ms")
    taken = []
    for _ in range(2):
        began = time.process_time()
        follow_stack(splats)
        bpy.context.view_layer.update()
        taken.append(time.process_time() - began)
    print(f"two, with probes: {pose_seconds([body, prop]) * 1000:.0f} ms")
    print(f"making the probes: {taken[0] * 1000:.0f} ms the first time, {taken[1] * 1000:.0f} ms again, with a pose")
    assert len(probes_of(splats)) == 4
    second.show_viewport = second.show_render = False
    follow_stack(splats)
    print(f"one again: {pose_seconds([body]) * 1000:.0f} ms")


def pose_seconds(armatures: list[bpy.types.Object]) -> float:
    """Processor seconds of a pose change, the median of all rounds."""
    taken = []
    for turn in range(ROUNDS):
        for armature in armatures:
            for bone in list(armature.pose.bones)[3:6]:
                bone.rotation_mode = "QUATERNION"
                bone.rotation_quaternion = (1, 0.1 + 0.03 * turn, 0, 0)
        began = time.process_time()
        bpy.context.view_layer.update()
        taken.append(time.process_time() - began)
    return float(np.median(taken))


if __name__ == "__main__":
    main()
