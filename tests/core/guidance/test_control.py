# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gskin_addon.core.guidance.control import control_points, make_signals
from gskin_addon.core.guidance.mask import dynamic_mask, painting_mask, points_hull
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.rig.kinematics import pose_transforms
from tests.helpers.limb import make_limb


def test_control_points_are_the_displaced_joints():
    limb = make_limb(200)
    camera = paper_views(*limb.cloud.bounds(), 256)[0]
    rotations = np.tile(np.eye(3), (3, 1, 1))
    rotations[2] = Rotation.from_rotvec([0, 0.6, 0]).as_matrix()
    transforms = pose_transforms(limb.skeleton, rotations)
    handles, targets = control_points(limb.skeleton, transforms, camera)
    # Only the tip moves: the head of the last bone is what it turns about.
    assert handles.shape == targets.shape == (1, 2)
    np.testing.assert_allclose(handles[0], camera.project(limb.skeleton.tails[2])[0])
    tip = rotations[2] @ (1, 0, 0) + limb.skeleton.heads[2]
    np.testing.assert_allclose(targets[0], camera.project(tip)[0])


def test_control_points_are_joints_wherever_the_tails_are():
    """Tails that an importer made up, here after a hundredth of the limb, are no joints of the paper."""
    limb = make_limb(200)
    stubs = replace(limb.skeleton, tails=limb.skeleton.heads + (0.01, 0, 0))
    camera = paper_views(*limb.cloud.bounds(), 256)[0]
    rotations = np.tile(np.eye(3), (3, 1, 1))
    rotations[1] = Rotation.from_rotvec([0, 0.6, 0]).as_matrix()
    transforms = pose_transforms(limb.skeleton, rotations)
    handles, targets = control_points(stubs, transforms, camera)
    honest = control_points(limb.skeleton, transforms, camera)
    assert len(handles) == 2  # the last joint and the tip; the made-up tails would be two more
    order, expected = np.argsort(handles[:, 0]), np.argsort(honest[0][:, 0])
    np.testing.assert_allclose(handles[order], honest[0][expected], atol=1e-6)
    np.testing.assert_allclose(targets[order], honest[1][expected], atol=1e-6)


def test_rest_pose_has_no_control_points():
    limb = make_limb(200)
    camera = paper_views(*limb.cloud.bounds(), 256)[0]
    handles, targets = control_points(limb.skeleton, np.tile(np.eye(4), (3, 1, 1)), camera)
    assert handles.shape == targets.shape == (0, 2)


def test_signals_turn_about_their_view_axis():
    limb = make_limb(200)
    cameras = paper_views(*limb.cloud.bounds(), 64)
    signals = make_signals(limb.skeleton, cameras, 5, np.random.default_rng(0))
    assert [s.view for s in signals] == [v for v in range(4) for _ in range(5)]
    for signal in signals:
        turned = 0
        for transform in signal.transforms:
            vector = Rotation.from_matrix(transform[:3, :3]).as_rotvec()
            if np.linalg.norm(vector) > 1e-6:
                turned += 1
                along = abs(vector @ signal.camera.forward) / np.linalg.norm(vector)
                assert along > 1 - 1e-6
                assert 0.1 * np.pi - 1e-6 <= np.linalg.norm(vector) <= 0.33 * np.pi + 1e-6
        assert turned >= 1


def test_mask_is_the_hull_of_each_change():
    rest = np.ones((60, 80, 3), np.float32)
    posed = rest.copy()
    posed[10:21, 10] = posed[10, 10:21] = 0.0  # an L: its hull is a triangle
    posed[40:45, 50:60] = 0.5  # a box of its own
    posed[55, 5] = 0.0  # one pixel is noise
    mask = dynamic_mask(rest, posed)
    assert mask[12, 12]
    assert not mask[19, 19]
    assert mask[40:45, 50:60].all()
    assert not mask[30, 30]
    assert not mask[55, 5]
    assert 45 <= mask[:30, :40].sum() <= 80


def test_mask_of_equal_images_is_empty():
    image = np.random.default_rng(0).random((20, 20, 3))
    assert not dynamic_mask(image, image).any()


def test_mask_of_a_line_is_the_line():
    rest = np.ones((30, 30, 3))
    posed = rest.copy()
    posed[4:24, 7] = 0
    mask = dynamic_mask(rest, posed)
    assert mask[4:24, 7].all()
    assert mask.sum() == 20


def test_a_model_may_paint_between_the_control_points():
    rest = np.ones((60, 80, 3), np.float32)
    posed = rest.copy()
    posed[40:45, 50:60] = 0.5
    handles, targets = np.array([[10.0, 10.9], [30.2, 10.0]]), np.array([[10.0, 30.0], [300.0, 10.0]])
    mask = painting_mask(rest, posed, handles, targets)
    hull = points_hull(handles, targets, 60, 80)
    np.testing.assert_array_equal(mask, dynamic_mask(rest, posed) | hull)
    for x, y in ((10, 10), (30, 10), (10, 30), (79, 10), (20, 15)):
        assert mask[y, x]
    assert not mask[30, 60]
    assert not mask[9].any()
    assert not painting_mask(rest, rest, handles, targets).any()  # nothing is seen to move


def test_the_hull_of_few_points_is_a_dot_or_a_line():
    none = np.zeros((0, 2))
    assert not points_hull(none, none, 20, 20).any()
    assert np.argwhere(points_hull(np.array([[3.5, 4.0]]), none, 20, 20)).tolist() == [[4, 3]]
    line = points_hull(np.array([[2.0, 5.0], [4, 5]]), np.array([[9.0, 5.0], [np.nan, 1]]), 20, 20)
    assert np.argwhere(line).tolist() == [[5, x] for x in range(2, 10)]
