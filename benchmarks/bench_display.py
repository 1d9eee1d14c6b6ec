# SPDX-License-Identifier: GPL-3.0-or-later
"""What a posed frame costs with the display on, beside the rig alone (Armature modifier and rotation nodes).

Needs bpy. Usage: python -m benchmarks.bench_display [SPLATS ...]"""

from __future__ import annotations

import argparse
import time

import bpy
import numpy as np

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import write_weights

BONES = 20
ROUNDS = 10


def rigged(count: int, bones: int = BONES) -> tuple[bpy.types.Object, bpy.types.Object]:
    """`count` mostly opaque splats on a chain of bones."""
    rng = np.random.default_rng(0)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for index in range(bones):
        bone = armature.data.edit_bones.new(f"bone.{index:02d}")
        bone.head, bone.tail = (0, 0, 2 * index / bones), (0, 0, 2 * (index + 1) / bones)
    bpy.ops.object.mode_set(mode="OBJECT")
    quats = rng.normal(size=(count, 4))
    cloud = SplatCloud(
        means=rng.uniform((-0.3, -0.3, 0), (0.3, 0.3, 2), (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.full((count, 3), 0.01, np.float32),
        opacities=rng.uniform(0.2, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )
    obj = create_splat_object(cloud, "Splats")
    near = np.exp(-bones * np.abs(cloud.means[:, 2:] - 2 * (np.arange(bones) + 0.5) / bones))
    write_weights(obj, armature, near / near.sum(axis=1, keepdims=True))
    return obj, armature


def frame(armature: bpy.types.Object, angle: float) -> float:
    """Seconds from a pose to its evaluated scene."""
    armature.pose.bones[3].rotation_quaternion = (1, angle, 0, 0)
    began = time.perf_counter()
    bpy.context.view_layer.update()
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("splats", type=int, nargs="*", default=[40_000, 120_000])
    for count in parser.parse_args().splats:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        obj, armature = rigged(count)
        modifier = find_display(obj)
        taken: dict[bool, list[float]] = {False: [], True: []}
        # In turns, so that other work on the machine meets both.
        for turn in range(ROUNDS):
            for shown in (False, True):
                modifier.show_viewport = shown
                bpy.context.view_layer.update()
                taken[shown] += [frame(armature, 0.1 + 0.03 * turn + 0.01 * k) for k in range(3)]
        rig, display = (1e3 * np.median(taken[shown]) for shown in (False, True))
        best_rig, best = (1e3 * min(taken[shown]) for shown in (False, True))
        print(
            f"{count:,} splats: rig {rig:.1f} ms, with display {display:.1f} ms, {display / rig:.1f}-fold "
            f"(least: {best_rig:.1f}, {best:.1f} ms, {best / best_rig:.1f}-fold)"
        )


if __name__ == "__main__":
    main()
