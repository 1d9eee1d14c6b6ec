# SPDX-License-Identifier: GPL-3.0-or-later
"""Spherical harmonics and axes, against the sphere itself and scipy."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.axes import UP_AXES, rotate_cloud, rotate_in_place, rotation_quat, turn_quats, up_rotation
from gskin_addon.core.splats.ply import read_ply
from gskin_addon.core.splats.sh import eval_sh, rotate_sh, sh_basis
from gskin_addon.core.ticks import run_to_end


def random_dirs(count: int, seed: int = 0) -> np.ndarray:
    dirs = np.random.default_rng(seed).normal(size=(count, 3))
    return dirs / np.linalg.norm(dirs, axis=1, keepdims=True)


def test_basis_is_orthonormal_on_the_sphere():
    # Gauss-Legendre in z times uniform in angle integrates polynomials of degree 8 exactly.
    z, weight = np.polynomial.legendre.leggauss(12)
    angle = np.arange(24) * 2.0 * np.pi / 24
    radius = np.sqrt(1.0 - z * z)
    dirs = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.repeat(z[:, None], 24, axis=1)],
        axis=-1,
    )
    basis = sh_basis(dirs, 4)
    gram = np.einsum("iak,ial,i->kl", basis, basis, weight * 2.0 * np.pi / 24)
    np.testing.assert_allclose(gram, np.eye(25), atol=1e-12)


def test_signs_of_the_inria_renderer():
    """Colour of the first band: SH_C1 * (-y sh1 + z sh2 - x sh3)."""
    sh = np.zeros((3, 4, 3), np.float32)
    sh[:, 1:] = np.eye(3)
    dirs = np.eye(3, dtype=np.float32)
    c1 = 0.4886025119029199
    expected = 0.5 + np.array([[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]])
    np.testing.assert_allclose(eval_sh(sh, dirs), expected, atol=1e-6)


def test_eval_matches_float64_and_clips():
    cloud = clouds.random_cloud(500, 4)
    dirs = random_dirs(500)
    expected = np.maximum(0.0, 0.5 + np.einsum("nk,nkc->nc", sh_basis(dirs, 4), cloud.sh.astype(np.float64)))
    colors = eval_sh(cloud.sh, dirs.astype(np.float32))
    np.testing.assert_allclose(colors, expected, atol=2e-5)
    assert (colors == 0.0).any()


@settings(max_examples=30, deadline=None)
@given(degree=st.integers(0, 4), seed=st.integers(0, 10**6))
def test_turned_harmonics_look_the_same_from_turned_directions(degree, seed):
    R = Rotation.random(random_state=seed).as_matrix()
    sh = clouds.random_cloud(20, degree, seed).sh
    dirs = random_dirs(20, seed)
    before = np.einsum("nk,nkc->nc", sh_basis(dirs, degree), sh.astype(np.float64))
    after = np.einsum("nk,nkc->nc", sh_basis(dirs @ R.T, degree), rotate_sh(sh, R).astype(np.float64))
    np.testing.assert_allclose(after, before, atol=2e-5)


def test_one_rotation_per_splat():
    sh = clouds.random_cloud(40, 3).sh
    R = Rotation.random(40, random_state=1).as_matrix()
    expected = np.concatenate([rotate_sh(sh[i : i + 1], R[i]) for i in range(40)])
    np.testing.assert_allclose(rotate_sh(sh, R), expected, atol=1e-6)


def test_partial_bands_are_refused():
    with pytest.raises(ValueError, match="5 spherical-harmonic coefficients"):
        rotate_sh(np.zeros((2, 5, 3), np.float32), np.eye(3))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), half_turn=st.booleans())
def test_turning_quaternions(seed, half_turn):
    rotation = Rotation.random(random_state=seed)
    if half_turn:
        rotation = Rotation.from_rotvec(np.pi * random_dirs(1, seed)[0])
    cloud = clouds.random_cloud(10, 0, seed)
    turned = turn_quats(rotation_quat(rotation.as_matrix()), cloud.quats)
    matrices = Rotation.from_quat(np.roll(turned, -1, axis=1)).as_matrix()
    expected = rotation.as_matrix() @ Rotation.from_quat(np.roll(cloud.quats, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(matrices, expected, atol=1e-6)


def test_turning_a_cloud_there_and_back():
    cloud = clouds.random_cloud(200, 3)
    R = Rotation.random(random_state=5).as_matrix()
    back = rotate_cloud(rotate_cloud(cloud, R), R.T)
    np.testing.assert_allclose(back.means, cloud.means, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(back.quats * cloud.quats, axis=1)), 1.0, atol=1e-6)
    np.testing.assert_allclose(back.sh, cloud.sh, atol=1e-5)
    assert rotate_cloud(cloud, np.eye(3)) is cloud


def test_mirrors_and_scales_are_refused():
    cloud = clouds.random_cloud(2, 0)
    for R in (np.diag([1.0, 1.0, -1.0]), 2.0 * np.eye(3)):
        with pytest.raises(ValueError, match="no rotation"):
            rotate_cloud(cloud, R)


def test_up_axes():
    for up, axis in (("z", [0, 0, 1]), ("y", [0, 1, 0]), ("-y", [0, -1, 0])):
        R = up_rotation(up)
        np.testing.assert_array_equal(R @ axis, [0, 0, 1])
        assert np.linalg.det(R) == 1.0
    np.testing.assert_array_equal(up_rotation("-y") @ [1, 2, 3], [1, 3, -2])
    with pytest.raises(InputError, match="use one of z, y, -y"):
        up_rotation("x")


@pytest.mark.skipif(not clouds.ASSETS.is_dir(), reason="no shared assets")
def test_biker_stands_on_its_rig():
    """With up = -y the person's splats surround the joints of the rig that was placed in PLY axes."""
    rig = json.loads((clouds.ASSETS / "splats" / "pc_biker_rig.json").read_text())["bones"]
    R = up_rotation("-y")
    cloud = rotate_cloud(read_ply(clouds.ASSETS / "splats" / "pc_biker.ply").cloud, R)
    assert R @ rig["head"]["tail"] @ [0, 0, 1] > 3.0
    for bone in rig.values():
        middle = R @ (np.add(bone["head"], bone["tail"]) / 2.0)
        assert np.linalg.norm(cloud.means - middle, axis=1).min() < 0.15


@pytest.mark.parametrize("up", UP_AXES)
def test_turning_in_place_is_turning(up):
    """Piece by piece, the normals and the way back of far splats too."""
    cloud = clouds.random_cloud(40_000, 2)
    normals = {name: np.random.default_rng(k).normal(size=40_000) for k, name in enumerate(("nx", "ny", "nz"))}
    cloud = replace(cloud, extra=normals, offset=np.array([1000.0, 0.0, 5.0]), up=up)
    wanted = rotate_cloud(cloud, up_rotation(up))
    found = run_to_end(rotate_in_place(cloud, up_rotation(up)))
    for name in ("means", "quats", "sh", "offset", "up"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    for name in normals:
        np.testing.assert_array_equal(found.extra[name], wanted.extra[name])
