# SPDX-License-Identifier: GPL-3.0-or-later
"""The display's arithmetic against the float64 reference and against differences of the projection itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.render.camera import Camera, look_at
from gskin_addon.core.render.screen_space import (
    camera_matrices,
    covariances,
    is_orthographic,
    jacobian,
    project,
    window_depths,
)
from gskin_addon.core.rig.quaternion import quat_to_matrix


def shifted(camera: Camera) -> Camera:
    return replace(camera, fy=1.3 * camera.fy, cx=0.4 * camera.width, cy=0.7 * camera.height)


def orthographic(width: float, size: tuple[int, int], shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    P = np.diag([2 / width, 2 / width * size[1] / size[0], -2 / 100, 1.0])
    P[:2, 3] = shift
    return P


def in_view(cloud, view):
    linear = view[:3, :3]
    points = cloud.means.astype(np.float64) @ linear.T + view[:3, 3]
    axes = linear @ (quat_to_matrix(cloud.quats.astype(np.float64)) * cloud.scales[:, None, :])
    return points, axes


@pytest.mark.parametrize("lens", ["plain", "shifted"])
def test_projection_and_covariances_are_those_of_the_reference(lens):
    torch = pytest.importorskip("torch")
    from gskin_addon.core.render import reference

    cloud = clouds.random_cloud(300, 0, seed=3)
    camera = look_at((2.0, -1.5, 0.7), (0, 0, 0), size=(240, 320))
    camera = camera if lens == "plain" else shifted(camera)
    view, projection = camera_matrices(camera)
    points, axes = in_view(cloud, view)
    means, quats, scales = (torch.as_tensor(a.astype(np.float64)) for a in (cloud.means, cloud.quats, cloud.scales))
    pixels, depth, wanted = (t.numpy() for t in reference.project(means, quats, scales, camera))
    inside = (depth > 0.05) & (pixels > -40).all(1) & (pixels < [360, 280]).all(1)
    assert inside.sum() > 100
    mine, my_depth = project(points, projection, camera.size)
    np.testing.assert_allclose(my_depth, depth, atol=1e-9)
    np.testing.assert_allclose(mine[inside], pixels[inside], atol=1e-7)
    got = covariances(axes, points, projection, camera.size)
    # Rows of the picture go down, the screen's y goes up.
    got[:, 0, 1], got[:, 1, 0] = -got[:, 0, 1], -got[:, 1, 0]
    front = depth > 0.05
    # Also beyond the picture's edge, where the Jacobian is held back.
    np.testing.assert_allclose(got[front], wanted[front], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_window_depths_are_those_of_the_projected_points(kind):
    camera = replace(look_at((2.0, -1.5, 0.7), (0, 0, 0), size=(24, 32)), orthographic=kind == "orthographic", near=0.2)
    _, projection = camera_matrices(camera, 40.0)
    away = np.array([0.2, 1.0, 7.0, 40.0])
    clip = projection @ np.stack([away * 0.1, away * 0.2, -away, np.ones(4)])
    got = window_depths(np.append(away, np.inf), projection)
    np.testing.assert_allclose(got[:4], 0.5 * clip[2] / clip[3] + 0.5, atol=1e-6)
    np.testing.assert_allclose(got[[0, 3, 4]], [0.0, 1.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "sheared"])
def test_the_jacobian_is_the_derivative_of_the_projection(kind):
    size = (240, 320)
    if kind == "perspective":
        _, projection = camera_matrices(shifted(look_at((0, -3, 0), (0, 0, 0), size=size)))
    else:
        projection = orthographic(3.0, size, (0.2, -0.1))
        if kind == "sheared":
            projection[0, 2], projection[1, 2] = 0.05, -0.02
    assert is_orthographic(projection) == (kind != "perspective")
    random = np.random.default_rng(0)
    points = np.stack([random.uniform(-0.4, 0.4, 50), random.uniform(-0.4, 0.4, 50), random.uniform(-4, -2, 50)], 1)
    J = jacobian(points, projection, size)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        moved = project(points + step, projection, size)[0] - project(points - step, projection, size)[0]
        np.testing.assert_allclose(J[:, :, axis], moved / 2e-6 * [1, -1], rtol=1e-5, atol=1e-4)


def test_matrices_of_an_orthographic_camera():
    turn, shift = look_at((1, -3, 0.5), (0, 0, 0), size=8).rotation, np.array([0.1, 0.2, 3.0])
    camera = Camera(turn, shift, 30.0, 20.0, 25.0, 11.0, 60, 40, 0.5, orthographic=True)
    points = np.random.default_rng(0).normal(0, 0.6, (20, 3))
    view, projection = camera_matrices(camera, 50.0)
    there = points @ view[:3, :3].T + view[:3, 3]
    pixels, depths = project(there, projection, camera.size)
    wanted, z = camera.project(points)
    np.testing.assert_allclose(pixels, wanted, atol=1e-9)
    np.testing.assert_allclose(depths, z, atol=1e-9)
    window = there[:, 2] * projection[2, 2] + projection[2, 3]
    np.testing.assert_allclose(window, 2 * (z - 0.5) / 49.5 - 1, atol=1e-9)
