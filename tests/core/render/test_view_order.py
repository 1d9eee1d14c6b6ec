# SPDX-License-Identifier: GPL-3.0-or-later
"""Order and view-dependent colours of drawn splats, with and without pose, in perspective and orthographic views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.drawn_splats import DrawnSplats, drawn_cloud, largest
from gskin_addon.core.render.screen_space import camera_matrices
from gskin_addon.core.render.view_order import arrange, back_to_front, eye_of, view_colors, view_depths
from gskin_addon.core.rig.quaternion import normalize, quat_to_matrix
from gskin_addon.core.splats.cloud import SH_C0, SplatCloud
from gskin_addon.core.splats.sh import rotate_sh

C1 = 0.4886025119029199


def made_up(degree: int, count: int = 60, seed: int = 0) -> SplatCloud:
    random = np.random.default_rng(seed)
    return SplatCloud(
        means=random.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=normalize(random.normal(size=(count, 4))).astype(np.float32),
        scales=random.uniform(0.01, 0.05, (count, 3)).astype(np.float32),
        opacities=random.uniform(0.1, 1, count).astype(np.float32),
        sh=random.uniform(-0.15, 0.15, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def matrix(seed: int) -> np.ndarray:
    """A turn, a scale of 1.7 and a move."""
    random = np.random.default_rng(seed)
    M = np.eye(4)
    M[:3, :3] = 1.7 * quat_to_matrix(random.normal(size=4))
    M[:3, 3] = random.uniform(-1, 1, 3)
    return M


def orthographic() -> np.ndarray:
    return np.diag([0.5, 0.5, -0.02, 1.0])


VIEW, PERSPECTIVE = camera_matrices(look_at((2.0, -4.0, 1.5), (0, 0, 0), size=100))


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_order_is_that_of_a_plain_sort(count):
    random = np.random.default_rng(1)
    depths = (random.normal(size=count) * 10.0 ** random.uniform(-6, 6, count)).astype(np.float32)
    depths[: count // 5] = np.repeat(depths[: count // 10], 2)[: count // 5]
    depths[count // 2 : count // 2 + 2] = 0.0
    np.testing.assert_array_equal(back_to_front(depths), np.argsort(-depths, kind="stable"))


def test_order_of_two_objects_is_one_order():
    first, second = drawn_cloud(made_up(0, 40, 1), matrix(1)), drawn_cloud(made_up(0, 30, 2), matrix(2))
    order, colors = arrange([first, second], VIEW, PERSPECTIVE)
    world = [s.points @ s.matrix[:3, :3].T + s.matrix[:3, 3] for s in (first, second)]
    depth = -(np.concatenate(world) @ VIEW[2, :3] + VIEW[2, 3])
    np.testing.assert_allclose(np.concatenate([view_depths(s, VIEW) for s in (first, second)]), depth, atol=1e-5)
    assert (np.diff(depth[order]) <= 1e-5).all()
    assert sorted(order) == [*range(70)]
    assert [len(c) for c in colors] == [40, 30]


def test_a_known_harmonic_of_degree_one():
    """Only the z function: brighter by C1 seen from below, looking up, and darker from above; nothing from the side."""
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0], sh[0, 2] = 0.1 / SH_C0, 0.5
    splat = replace(drawn_cloud(made_up(1, 1)), sh=sh, points=np.zeros((1, 3), np.float32))
    for eye, along in (((0, 0, -3), 1.0), ((0, 0, 3), -1.0), ((4, 0, 0), 0.0)):
        view, projection = camera_matrices(look_at(eye, (0, 0, 0), size=64))
        wanted = 0.6 + 0.5 * C1 * along
        for P in (projection, orthographic()):
            got = view_colors(splat, eye_of(view, P, np.eye(4)))
            np.testing.assert_allclose(got, wanted, atol=1e-6)
    # A quarter turn about x takes z to -y: what was seen from below is now seen looking along -y.
    turned = replace(splat, turns=np.array([[1, 1, 0, 0]], np.float32))
    view, projection = camera_matrices(look_at((0, 3, 0), (0, 0, 0), size=64))
    for P in (projection, orthographic()):
        np.testing.assert_allclose(view_colors(turned, eye_of(view, P, np.eye(4))), 0.6 + 0.5 * C1, atol=1e-6)


@pytest.mark.parametrize("projection", [PERSPECTIVE, orthographic()], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("posed", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_turning_the_ray_back_is_turning_the_harmonics(degree, posed, projection):
    """Against coefficients turned by the bones and by the object, looked at from the world."""
    cloud, M = made_up(degree), matrix(5)
    turns = np.random.default_rng(7).normal(size=(cloud.count, 4)).astype(np.float32) if posed else None
    splats = replace(drawn_cloud(cloud, M), turns=turns)
    got = view_colors(splats, eye_of(VIEW, projection, M))

    R = M[:3, :3] / 1.7
    whole = R @ quat_to_matrix(turns) if posed else np.broadcast_to(R, (cloud.count, 3, 3))
    sh = rotate_sh(cloud.sh, whole)
    world = cloud.means @ M[:3, :3].T + M[:3, 3]
    eye = np.linalg.inv(VIEW)[:3, 3]
    rays = world - eye if projection is PERSPECTIVE else np.broadcast_to(-VIEW[2, :3], world.shape)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    from gskin_addon.core.splats.sh import sh_basis

    wanted = np.maximum(np.einsum("nk,nkc->nc", sh_basis(rays, degree), sh) + 0.5, 0)
    np.testing.assert_allclose(got, wanted, atol=2e-5)
    if degree:
        other = view_colors(replace(splats, turns=np.roll(turns, 1, axis=0)) if posed else splats,
                            eye_of(VIEW, projection, M if posed else np.eye(4)))  # fmt: skip
        assert np.abs(other - wanted).max() > 0.01, "the colours do not depend on the direction"


def test_other_colours_take_the_harmonics_place():
    chosen = np.random.default_rng(0).random((60, 3)).astype(np.float32)
    splats = replace(drawn_cloud(made_up(2)), colors=chosen)
    np.testing.assert_array_equal(view_colors(splats, eye_of(VIEW, PERSPECTIVE, np.eye(4))), chosen)


def test_the_largest_are_those_that_hide_most():
    cloud = made_up(0, 100)
    index = largest(cloud.scales, cloud.opacities, 30)
    long = np.sort(cloud.scales, axis=1)[:, 1:].prod(axis=1) * cloud.opacities
    assert set(index) == set(np.argsort(-long)[:30])
    assert (np.diff(index) > 0).all()
    assert largest(cloud.scales, cloud.opacities, 100) is None
    picked = drawn_cloud(cloud).select(index)
    assert isinstance(picked, DrawnSplats)
    np.testing.assert_array_equal(picked.points, cloud.means[index])
    assert picked.turns is None
