# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawn skeletons, against the joints' own projection."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.guidance.skeleton_image import bone_color, draw_bones, project_bones
from gskin_addon.core.render.camera import look_at
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.segments import bone_segments
from tests.helpers.limb import make_limb

SIZE = (96, 128)


@pytest.fixture(scope="module")
def limb():
    return make_limb(50)


@pytest.fixture(scope="module")
def camera(limb):
    low, high = limb.cloud.bounds()
    middle = (low + high) / 2
    return look_at(middle + (0.3, -2.5 * np.linalg.norm(high - low), 0.2), middle, size=SIZE)


def posed(skeleton):
    turn = np.tile(np.eye(3), (1, skeleton.count, 1, 1))
    angle = 0.7
    turn[0, -1] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    return pose_transforms(skeleton, turn)[0]


def test_joints_and_limbs_are_where_the_camera_sees_them(limb, camera):
    transforms = posed(limb.skeleton)
    bones = project_bones(limb.skeleton, transforms, camera)
    segments = bone_segments(limb.skeleton)
    np.testing.assert_array_equal(bones.bone, segments.bone)
    for places, moves in ((bones.rest, np.tile(np.eye(4), (limb.skeleton.count, 1, 1))), (bones.posed, transforms)):
        image = draw_bones(places, bones.bone, SIZE)
        assert image.shape == (*SIZE, 3)
        assert image.dtype == np.uint8
        lit = image.any(axis=-1)
        assert 0 < lit.mean() < 0.2
        for number, bone in enumerate(segments.bone):
            ends = [
                moves[bone, :3, :3] @ point + moves[bone, :3, 3]
                for point in (segments.starts[number], segments.ends[number])
            ]
            for point in ends:
                x, y = camera.project(point)[0]
                assert lit[int(y), int(x)]
            x, y = camera.project(np.mean(ends, axis=0))[0]
            np.testing.assert_allclose(image[int(y), int(x)] / 255, bone_color(int(bone)), atol=0.01)
    assert np.abs(bones.rest - bones.posed).max() > 5


def test_near_bones_hide_far_ones_and_neighbours_differ():
    across = np.array([[[4, 20, 1.0], [36, 20, 1.0]], [[20, 4, 2.0], [20, 36, 2.0]]])
    for depths, seen in (((1.0, 2.0), 0), ((2.0, 1.0), 1)):
        across[0, :, 2], across[1, :, 2] = depths
        image = draw_bones(across, np.array([0, 1]), (40, 40))
        np.testing.assert_allclose(image[20, 20] / 255, bone_color(seen), atol=0.01)
    colours = np.array([bone_color(bone) for bone in range(40)])
    assert np.abs(colours[1:] - colours[:-1]).max(axis=1).min() > 0.3
    gaps = np.abs(colours[:, None] - colours[None]).max(axis=-1) + np.eye(40)
    assert gaps.min() > 0.02


def test_what_is_behind_the_camera_or_outside_is_left_out():
    away = np.array([[[np.nan, np.nan, -1.0], [5, 5, 1.0]], [[500, 5, 1.0], [600, 5, 1.0]]])
    assert not draw_bones(away, np.array([0, 1]), (40, 40)).any()
