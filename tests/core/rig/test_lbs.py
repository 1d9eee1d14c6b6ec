# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning against a splat-by-splat, bone-by-bone float64 reference."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gskin_addon.core.rig import lbs
from gskin_addon.core.rig.lbs import (
    few_influences,
    skin_cloud,
    skin_points,
    skin_quats,
    sparsify,
    top_influences,
)
from gskin_addon.core.rig.quaternion import axis_angle_to_matrix, quat_to_matrix
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.sh import eval_sh


def _case(n=40, bones=7, poses=3, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    weights = rng.dirichlet(np.full(bones, 0.3), size=n)
    transforms = np.tile(np.eye(4), (poses, bones, 1, 1))
    transforms[..., :3, :3] = Rotation.random(poses * bones, random_state=seed).as_matrix().reshape(
        poses, bones, 3, 3
    )
    transforms[..., :3, 3] = rng.normal(size=(poses, bones, 3))
    return points, weights, transforms


def _reference_points(points, weights, transforms):
    out = np.zeros((len(transforms), len(points), 3))
    for p, pose in enumerate(transforms):
        for n, x in enumerate(points):
            for b, matrix in enumerate(pose):
                out[p, n] += weights[n, b] * (matrix @ [*x, 1.0])[:3]
    return out


def _reference_rotation(weights, pose):
    """Eq. 3 spelt out: scipy's quaternions, each turned into the half space of the dominant bone's."""
    quats = np.roll(Rotation.from_matrix(pose[:, :3, :3]).as_quat(), 1, axis=1)
    out = []
    for row in weights:
        lead = quats[np.argmax(row)]
        total = sum(w * (q if q @ lead >= 0 else -q) for w, q in zip(row, quats, strict=True))
        total = total / np.linalg.norm(total)
        out.append(Rotation.from_quat(np.roll(total, -1)).as_matrix())
    return np.array(out)


def test_points_match_the_loops():
    points, weights, transforms = _case()
    expected = _reference_points(points, weights, transforms)
    np.testing.assert_allclose(skin_points(points, weights, transforms), expected, atol=1e-12)
    np.testing.assert_allclose(skin_points(points, weights, transforms[1]), expected[1], atol=1e-12)
    single = skin_points(points.astype(np.float32), weights.astype(np.float32), transforms)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, atol=1e-5)


def test_rotations_match_the_loops_and_the_bones_signs_do_not_matter():
    _, weights, transforms = _case(seed=1)
    got = quat_to_matrix(skin_quats(weights, transforms))
    for p in range(len(transforms)):
        np.testing.assert_allclose(got[p], _reference_rotation(weights, transforms[p]), atol=1e-9)


def test_a_single_bone_turns_the_covariance_exactly():
    rng = np.random.default_rng(2)
    transforms = np.tile(np.eye(4), (4, 1, 1))
    transforms[:, :3, :3] = axis_angle_to_matrix(rng.normal(size=(4, 3)), np.array([0.3, 1.9, 3.1, -2.5]))
    weights = np.eye(4)[rng.integers(0, 4, 30)]
    cloud = _cloud(30, 0, rng)
    posed = skin_cloud(cloud, weights, transforms)
    owner = transforms[np.argmax(weights, axis=1), :3, :3]
    before, after = _covariance(cloud), _covariance(posed)
    np.testing.assert_allclose(after, owner @ before @ owner.transpose(0, 2, 1), atol=1e-6)


def test_sign_alignment_survives_the_double_cover():
    """Turns of 170 and 190 degrees about one axis: w >= 0 quaternions lie almost opposite, so that an
    unaligned mean nearly vanishes, while the true mean turns by 180 degrees."""
    turn = axis_angle_to_matrix(np.tile([0.0, 0.6, 0.8], (2, 1)), np.radians([170.0, 190.0]))
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[:, :3, :3] = turn
    got = quat_to_matrix(skin_quats(np.array([[0.5, 0.5], [0.7, 0.3]]), transforms))
    np.testing.assert_allclose(got[0], axis_angle_to_matrix([0, 0.6, 0.8], np.pi), atol=1e-12)
    angle = np.degrees(Rotation.from_matrix(got[1]).magnitude())
    assert 175 < angle < 177.5


def test_scale_in_a_transform_does_not_disturb_the_rotation():
    _, weights, transforms = _case(seed=3)
    scaled = transforms.copy()
    scaled[..., :3, :3] *= 2.5
    np.testing.assert_allclose(skin_quats(weights, scaled), skin_quats(weights, transforms), atol=1e-12)


def test_colours_turn_with_the_splats():
    rng = np.random.default_rng(4)
    cloud = _cloud(20, 2, rng)
    transforms = np.eye(4)[None].copy()
    transforms[0, :3, :3] = turn = axis_angle_to_matrix([1, 2, 3], 1.1)
    weights = np.ones((20, 1), dtype=np.float32)
    dirs = rng.normal(size=(20, 3)).astype(np.float32)
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    before = eval_sh(cloud.sh, dirs)
    after = eval_sh(skin_cloud(cloud, weights, transforms).sh, (dirs @ turn.T).astype(np.float32))
    np.testing.assert_allclose(after, before, atol=1e-5)
    kept = skin_cloud(cloud, weights, transforms, rotate_sh=False)
    np.testing.assert_array_equal(kept.sh, cloud.sh)


def test_skin_cloud_keeps_the_rest_of_the_splat():
    rng = np.random.default_rng(5)
    cloud = _cloud(10, 1, rng)
    _, weights, transforms = _case(10, 4, 1)
    posed = skin_cloud(cloud, weights, transforms[0])
    np.testing.assert_array_equal(posed.scales, cloud.scales)
    np.testing.assert_array_equal(posed.opacities, cloud.opacities)
    np.testing.assert_allclose(
        posed.means, _reference_points(cloud.means.astype(float), weights, transforms)[0], atol=1e-5
    )
    with pytest.raises(ValueError, match="one pose"):
        skin_cloud(cloud, weights, transforms)


def test_top_influences_against_sorting():
    rng = np.random.default_rng(6)
    weights = rng.dirichlet(np.full(9, 0.5), size=50).astype(np.float32)
    index, value = top_influences(weights, 4)
    for row, i, v in zip(weights, index, value, strict=True):
        best = np.sort(row)[::-1][:4]
        np.testing.assert_allclose(v, best / best.sum(), rtol=1e-5)
        np.testing.assert_allclose(row[i], best)
    dense = sparsify(weights, 4)
    assert dense.dtype == np.float32
    assert (np.count_nonzero(dense, axis=1) <= 4).all()
    np.testing.assert_allclose(dense.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(sparsify(weights, 20), weights, atol=1e-6)


def whole_rows_sorted(weights, k):
    """`top_influences` before it worked by parts."""
    k = min(k, weights.shape[1])
    if k < weights.shape[1]:
        index = np.argpartition(-weights, k - 1, axis=1)[:, :k]
    else:
        index = np.broadcast_to(np.arange(k), weights.shape).copy()
    value = np.take_along_axis(weights, index, axis=1)
    order = np.argsort(-value, axis=1, kind="stable")
    index = np.take_along_axis(index, order, axis=1)
    value = np.maximum(np.take_along_axis(value, order, axis=1), 0)
    total = value.sum(axis=1, keepdims=True)
    value = value / np.where(total > 0, total, 1)
    value[total[:, 0] <= 0, 0] = 1
    return index, value


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32])
@pytest.mark.parametrize("part", [1, 7, 40, 1 << 18])
@pytest.mark.parametrize("k", [1, 4, 8, 20])
def test_parts_give_the_same_bits(monkeypatch, dtype, part, k):
    monkeypatch.setattr(lbs, "PART", part)
    rng = np.random.default_rng(7)
    weights = (100 * rng.dirichlet(np.full(12, 0.3), size=101)).astype(dtype)
    weights[[3, 60]] = 0
    index, value = top_influences(weights, k)
    wanted_index, wanted_value = whole_rows_sorted(weights, k)
    np.testing.assert_array_equal(index, wanted_index)
    np.testing.assert_array_equal(value, wanted_value)
    assert value.dtype == wanted_value.dtype
    assert top_influences(weights[:0], k)[0].shape == (0, min(k, 12))


def test_sorting_takes_less_memory_than_the_weights():
    weights = np.random.default_rng(8).random((40_000, 100), dtype=np.float32)
    tracemalloc.start()
    try:
        top_influences(weights, 4)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < weights.nbytes


@pytest.mark.parametrize("k", [1, 3, 4, 9, 12])
def test_sparse_rows_need_no_sorting_for_the_same_bits(k):
    rng = np.random.default_rng(9)
    weights = sparsify(rng.dirichlet(np.full(12, 0.5), size=300).astype(np.float32), k)
    index, value = few_influences(weights, k)
    wanted_index, wanted = top_influences(weights, k)
    np.testing.assert_array_equal(value, wanted)
    np.testing.assert_array_equal(np.where(value > 0, index, -1), np.where(wanted > 0, wanted_index, -1))


def test_rows_with_more_bones_or_none_are_left_to_sorting():
    weights = np.array([[0.5, 0.5, 0], [0.2, 0.3, 0.5]], np.float32)
    assert few_influences(weights, 2) is None
    assert few_influences(np.zeros((2, 3), np.float32), 2) is None
    assert few_influences(weights, 0) is None
    index, value = few_influences(np.array([[0.5, 0, 0.5]]), 5)
    np.testing.assert_array_equal(index[0, :2], [0, 2])  # of two equal ones the first comes first
    np.testing.assert_array_equal(value, [[0.5, 0.5, 0]])


def test_a_splat_without_weights_follows_one_bone():
    np.testing.assert_allclose(sparsify(np.zeros((2, 3)), 2).sum(axis=1), 1)
    with pytest.raises(ValueError, match="at least one influence"):
        top_influences(np.ones((1, 2)), 0)


def test_wrong_shapes_are_refused():
    points, weights, transforms = _case()
    with pytest.raises(ValueError, match="weights have shape"):
        skin_points(points, weights[:, :3], transforms)
    with pytest.raises(ValueError, match="transforms have shape"):
        skin_quats(weights, transforms[..., :3, :3])


def _cloud(count: int, degree: int, rng: np.random.Generator) -> SplatCloud:
    quats = rng.normal(size=(count, 4))
    return SplatCloud(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=rng.uniform(0.05, 1, size=(count, 3)),
        opacities=rng.uniform(size=count),
        # Small next to the constant 0.5, so that eval_sh does not clip.
        sh=0.05 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def _covariance(cloud: SplatCloud) -> np.ndarray:
    r = quat_to_matrix(cloud.quats.astype(np.float64))
    return (r * cloud.scales[:, None, :].astype(np.float64) ** 2) @ r.transpose(0, 2, 1)
