# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial weights by distance and silhouette visibility, against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.extent import robust_bounds, unit_frame
from gskin_addon.core.skinning.initial import (
    INITIAL_WEIGHTS,
    check_options,
    falloff_weights,
    initial_weights,
    initial_weights_visibility,
)
from gskin_addon.core.skinning.visibility import bone_visibility, grow_masks
from gskin_addon.core.splats.cloud import SplatCloud

SIZE = 128


def _two_legs(count: int = 3000, seed: int = 0) -> tuple[np.ndarray, Skeleton]:
    """Two tall boxes side by side with a gap, joined by a slab on top; a bone in each part."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-0.5, 0.5, (count, 3))
    u[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    centre = np.array([[-0.3, 0, 0.5], [0.3, 0, 0.5], [0, 0, 1.2]])
    size = np.array([[0.35, 0.3, 1.1], [0.35, 0.3, 1.1], [0.95, 0.3, 0.4]])
    part = rng.integers(0, 3, count)
    skeleton = Skeleton(
        ("left", "right", "hips"),
        np.array([-1, -1, -1]),
        np.array([[-0.3, 0, 0.9], [0.3, 0, 0.9], [-0.3, 0, 1.2]]),
        np.array([[-0.3, 0, 0.1], [0.3, 0, 0.1], [0.3, 0, 1.2]]),
    )
    return centre[part] + u * size[part], skeleton


def _masks(points, cameras):
    """The exact silhouettes of `_two_legs` are boxes; splatting its points densely comes close enough."""
    masks = []
    for camera in cameras:
        pixels, _ = camera.project(points)
        mask = np.zeros((camera.height, camera.width), dtype=bool)
        j, i = np.floor(pixels).astype(int).T
        mask[i.clip(0, camera.height - 1), j.clip(0, camera.width - 1)] = True
        masks.append(mask)
    return grow_masks(np.array(masks), 1)


def _scene(scale: float = 1.0, shift: tuple[float, float, float] = (0, 0, 0)):
    points, skeleton = _two_legs()
    dense, _ = _two_legs(60000, 1)
    points, dense = scale * points + shift, scale * dense + shift
    skeleton = skeleton.moved(np.eye(3), scale, shift)
    cameras = paper_views(dense.min(0), dense.max(0), SIZE)
    return points, skeleton, _masks(dense, cameras), cameras


def _segment_distance(p, a, b):
    t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return a + t * (b - a)


def test_visibility_matches_a_plain_walk_over_the_pixels():
    """Every pixel on the way is looked at here; the kernel looks at every second one, so they may differ
    where a segment only grazes the silhouette: the kernel may not call invisible what the full walk sees."""
    points, skeleton, masks, cameras = _scene()
    points = points[:150]
    squared, visible = bone_visibility(points, skeleton, masks, cameras, slack=0)
    expected = np.ones_like(visible)
    for n, p in enumerate(points):
        for b in range(skeleton.count):
            q = _segment_distance(p, skeleton.heads[b], skeleton.tails[b])
            assert squared[n, b] == pytest.approx(((p - q) ** 2).sum())
            for mask, camera in zip(masks, cameras, strict=True):
                (start, end), _ = camera.project(np.array([p, q]))
                line = start + np.linspace(0, 1, 1000)[:, None] * (end - start)
                j, i = np.floor(line).astype(int).T
                if mask[i[0], j[0]] and not mask[i, j].all():
                    expected[n, b] = False
    assert 0.2 < expected.mean() < 0.8
    assert not (visible < expected).any()
    assert (visible != expected).mean() < 0.02


def test_the_gap_between_legs_is_penalised():
    points, skeleton, masks, cameras = _scene()
    weights = initial_weights_visibility(points, skeleton, masks, cameras)
    plain = initial_weights_visibility(points, skeleton, masks, cameras, delta=0.0)
    inner = (np.abs(points[:, 0] + 0.125) < 0.02) & (points[:, 2] < 0.8)
    assert inner.sum() > 20
    assert weights[inner, 1].max() < 0.03
    assert (weights[inner, 1] < 0.5 * plain[inner, 1]).all()


def test_equation_6_and_7_spelt_out():
    points, skeleton, masks, cameras = _scene()
    squared, visible = bone_visibility(points, skeleton, masks, cameras)
    diagonal = np.linalg.norm(points.max(0) - points.min(0))
    d = squared / diagonal**2 + 0.1 * ~visible
    raw = (1 / (0.5 * d + 0.5 * d**2)) ** 2
    weights = initial_weights_visibility(points, skeleton, masks, cameras)
    assert weights.dtype == np.float32
    np.testing.assert_allclose(weights, raw / raw.sum(axis=1, keepdims=True), rtol=1e-5, atol=1e-9)


def _equation_6_and_7(points, bones, masks, cameras):
    """The paper's weights (N, S) with a walk over every pixel; bones: pairs of joints."""
    diagonal = np.linalg.norm(points.max(0) - points.min(0))
    d = np.empty((len(points), len(bones)))
    for n, p in enumerate(points):
        for b, (joint, parent) in enumerate(bones):
            q, sees = _segment_distance(p, joint, parent), True
            for mask, camera in zip(masks, cameras, strict=True):
                (start, end), _ = camera.project(np.array([p, q]))
                j, i = np.floor(start + np.linspace(0, 1, 1000)[:, None] * (end - start)).astype(int).T
                sees &= not mask[i[0], j[0]] or mask[i, j].all()
            d[n, b] = ((p - q) ** 2).sum() / diagonal**2 + 0.1 * (not sees)
    raw = (1 / (0.5 * d + 0.5 * d**2)) ** 2
    return raw / raw.sum(axis=1, keepdims=True)


def test_bones_go_from_joint_to_joint_wherever_their_tails_are():
    """Eq. 6 knows joints only: a made-up tail (glTF stores none) changes nothing."""
    points, _, masks, cameras = _scene()
    hips, ends = np.array([0, 0, 1.2]), [np.array([side * 0.3, 0, 0.1]) for side in (-1, 1)]
    tops = [np.array([side * 0.3, 0, 1.0]) for side in (-1, 1)]
    heads = np.array([hips, *tops, *(top + 0.5 * (end - top) for top, end in zip(tops, ends, strict=True))])
    names, parents = ("hips", "thigh.L", "thigh.R", "shin.L", "shin.R"), np.array([-1, 0, 0, 1, 2])
    stubs = Skeleton(names, parents, heads, heads + (0, 0, -0.01))
    bones = [(hips, tops[0]), (hips, tops[1]), (tops[0], heads[3]), (tops[1], heads[4])]
    bones += [(heads[3], ends[0]), (heads[4], ends[1])]
    dense = grow_masks(masks, 1)  # the kernel allows the silhouette a pixel
    few = np.concatenate([points[::23], [points.min(0), points.max(0)]])
    own = _equation_6_and_7(few, bones, dense, cameras)
    # The ways from the hips to the thighs turn as one here: Eq. 1 adds their weights.
    expected = np.column_stack([own[:, 0] + own[:, 1], own[:, 2:]])
    close = np.abs(initial_weights_visibility(few, stubs, masks, cameras) - expected).max(axis=1) < 1e-4
    assert close.mean() > 0.95  # the others graze the silhouette


def test_scale_and_place_do_not_matter():
    base = initial_weights_visibility(*_scene())
    moved = initial_weights_visibility(*_scene(40.0, (100.0, -30.0, 7.0)))
    # A segment along a pixel border may fall on its other side.
    assert (np.abs(base - moved).max(axis=1) > 1e-4).mean() < 0.01


def test_a_stray_far_away_changes_nothing_for_the_others():
    points, skeleton, masks, cameras = _scene()
    with_stray = np.concatenate([points, [[40.0, 0, 0]]])
    weights = initial_weights_visibility(with_stray, skeleton, masks, cameras)
    base = initial_weights_visibility(points, skeleton, masks, cameras)
    np.testing.assert_allclose(weights[:-1], base, atol=1e-6)
    assert weights[-1].sum() == pytest.approx(1, abs=1e-6)


def test_falloff_limits():
    w = falloff_weights(np.array([[0.0, 0.5, 1.0], [np.inf, np.inf, np.inf], [0.2, np.inf, 0.2]]))
    np.testing.assert_allclose(w, [[1, 0, 0], [1 / 3, 1 / 3, 1 / 3], [0.5, 0, 0.5]], atol=1e-6)
    d = np.array([[0.1, 0.2]])
    for gamma, sharpness in ((0.0, 1.0), (1.0, 1.0), (0.5, 2.0)):
        raw = (1 / ((1 - gamma) * d + gamma * d**2)) ** (2 * sharpness)
        np.testing.assert_allclose(falloff_weights(d, gamma, sharpness), raw / raw.sum(), rtol=1e-6)


def test_robust_bounds_keep_a_clean_box_and_drop_strays():
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * [1, 2, 0.001]
    low, high = robust_bounds(points)
    np.testing.assert_array_equal((low, high), (points.min(0), points.max(0)))
    strays = np.random.default_rng(1).uniform(-50, 50, (40, 3))
    low, high = robust_bounds(np.concatenate([points, strays]))
    np.testing.assert_allclose((low, high), (points.min(0), points.max(0)), atol=0.1)
    assert unit_frame(np.zeros((3, 3)))[1] == 1.0


def test_wrong_masks_and_unknown_names_are_refused():
    points, skeleton, masks, cameras = _scene()
    with pytest.raises(ValueError, match="masks have shape"):
        bone_visibility(points, skeleton, masks[:2], cameras)
    with pytest.raises(ValueError, match="a camera is"):
        bone_visibility(points, skeleton, masks[:, :64], cameras)
    cloud = _cloud(points)
    with pytest.raises(InputError, match=r"'warmth'.*learned or visibility or geodesic or heat"):
        initial_weights("warmth", cloud, skeleton, masks, cameras)


@pytest.mark.parametrize("name", list(INITIAL_WEIGHTS))
def test_every_method_gives_each_part_to_its_bone(name):
    points, skeleton, masks, cameras = _scene()
    weights = initial_weights(name, _cloud(points), skeleton, masks, cameras)
    assert weights.shape == (len(points), 3)
    assert weights.dtype == np.float32
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    low = points[:, 2] < 0.8
    np.testing.assert_array_equal(weights[low, :2].argmax(axis=1), points[low, 0] > 0)
    assert (weights[points[:, 2] > 1.3].argmax(axis=1) == 2).all()


def _cloud(points: np.ndarray) -> SplatCloud:
    n = len(points)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return SplatCloud(points, quats, np.full((n, 3), 0.01), np.ones(n), np.zeros((n, 1, 3)))


def test_options_of_a_method_are_checked(tmp_path):
    check_options("geodesic", {})
    check_options("learned", {"model": ""})
    with pytest.raises(InputError, match="'geodesic' have no option 'model'; it takes none"):
        check_options("geodesic", {"model": "x"})
    with pytest.raises(InputError, match="must be a path"):
        check_options("learned", {"model": 3})
    with pytest.raises(InputError, match="does not exist"):
        check_options("learned", {"model": str(tmp_path / "no.safetensors")})
