# SPDX-License-Identifier: GPL-3.0-or-later
"""The rotation nodes keep how the bones turned each splat, for whoever has to turn its harmonics."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from gskin_addon.core.rig.lbs import skin_quats
from gskin_addon.core.rig.quaternion import matrix_to_quat, quat_multiply
from gskin_addon.scene import names
from gskin_addon.scene.armature import pose_transforms_of
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.node_groups import set_display
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.transforms import world_similarity
from gskin_addon.scene.weights import read_weights, update_rotation_weights, write_weights

COUNT, BONES = 300, 6


@pytest.fixture
def posed():
    """Splats and armature with transforms of their own, posed; the first ten splats hang on no bone."""
    rng = np.random.default_rng(8)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    cloud = clouds.random_cloud(COUNT, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    rigs.place(armature, (1, 2, 0.3), (0.3, 0.4, 0.5), 1.7)
    rigs.place(obj, (0.5, -0.2, 0.3), (0.1, 0.9, -0.5), 0.7)
    write_weights(obj, armature, rigs.random_weights(cloud, BONES, rng))
    for group in obj.vertex_groups:
        group.remove(list(range(10)))
    update_rotation_weights(obj)
    set_display(obj, "Display", False)
    rigs.random_pose(armature, rng, 0.8)
    return obj, armature


def evaluated_turn(obj) -> np.ndarray:
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return read_attribute(evaluated.data, names.TURN).astype(np.float64)


def test_the_turn_is_the_blend_of_equation_3_in_the_objects_own_space(posed):
    obj, armature = posed
    weights = read_weights(obj)[0].astype(np.float64)[10:]
    world = skin_quats(weights / weights.sum(axis=1, keepdims=True), pose_transforms_of(armature))
    axes = matrix_to_quat(world_similarity(obj)[0])
    wanted = quat_multiply(quat_multiply(axes * [1, -1, -1, -1], world), axes)
    turn = evaluated_turn(obj)
    assert rigs.angles_between(turn[10:], wanted).max() < 1e-4
    assert rigs.angles_between(wanted, np.eye(4)[:1]).max() > 0.5  # the pose does turn


def test_splats_without_a_bone_are_not_turned(posed):
    obj, _ = posed
    assert rigs.angles_between(evaluated_turn(obj)[:10], np.eye(4)[:1]).max() < 1e-5


def test_the_object_itself_keeps_no_turn(posed):
    obj, _ = posed
    assert names.TURN not in obj.data.attributes
