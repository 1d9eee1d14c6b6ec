# SPDX-License-Identifier: GPL-3.0-or-later
"""Solid voxels and geodesic distances, against shapes with known answers and a plain graph search."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.poses import random_poses
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning import geodesic
from gskin_addon.core.skinning.geodesic import geodesic_distances
from gskin_addon.core.skinning.initial import initial_weights_geodesic
from gskin_addon.core.skinning.voxels import VoxelGrid, enclosure, voxelize
from gskin_addon.core.splats.from_mesh import sample_mesh

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).resolve().parents[4] / "shared" / "assets"))


def _bones(*segments: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Skeleton:
    ends = np.array(segments, dtype=float)
    names = tuple(f"bone{i}" for i in range(len(ends)))
    return Skeleton(names, np.full(len(ends), -1), ends[:, 0], ends[:, 1])


def _box(low, high, count, rng):
    """Points on the surface of a box."""
    u = rng.uniform(0, 1, (count, 3))
    u[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    return np.asarray(low) + u * (np.asarray(high) - np.asarray(low))


def _horseshoe(count: int = 30000) -> np.ndarray:
    """A U of three bars 0.2 thick: legs x = 0 and x = 1 of height 1, joined at the bottom."""
    rng = np.random.default_rng(0)
    bars = [((0, 0, 0), (0.2, 0.2, 1)), ((0.8, 0, 0), (1, 0.2, 1)), ((0, 0, 0), (1, 0.2, 0.2))]
    return np.concatenate([_box(low, high, count // 3, rng) for low, high in bars])


def test_a_hollow_sphere_becomes_solid_and_its_volume_is_right():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for faint in (1.0, 0.2):
        grid = voxelize(points, np.full(len(points), faint), 48)
        centre = grid.index(np.zeros(3))
        assert grid.solid[tuple(centre)]
        assert not grid.shell[tuple(centre)]
        volume = grid.solid.sum() * grid.pitch**3
        # Voxels that the surface crosses count whole: half a voxel more on all sides.
        assert 4 / 3 * np.pi < volume < 4 / 3 * np.pi * (1 + grid.pitch) ** 3
    assert max(grid.shape) <= 48 + 8


def test_a_hole_in_the_shell_does_not_empty_the_inside():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points = points[points[:, 2] > -0.95]
    grid = voxelize(points, np.ones(len(points)), 48)
    assert grid.solid[tuple(grid.index(np.zeros(3)))]
    assert not grid.solid[tuple(grid.index(np.array([0, 0, -1.1])))]


def test_the_gap_of_a_horseshoe_stays_open():
    grid = voxelize(_horseshoe(), np.ones(30000), 64)
    assert not grid.solid[tuple(grid.index(np.array([0.5, 0.1, 0.6])))]
    assert grid.solid[tuple(grid.index(np.array([[0.1, 0.1, 0.6], [0.5, 0.1, 0.1]])).T)].all()


def test_strays_faint_splats_and_large_splats():
    points = _horseshoe()
    rng = np.random.default_rng(1)
    strays = rng.uniform(-20, 20, (200, 3))
    haze = rng.uniform(0, 1, (500, 3)) * [1, 0.2, 1]
    opacity = np.concatenate([np.ones(len(points) + 200), np.full(500, 0.02)])
    clean = voxelize(points, np.ones(len(points)), 64)
    dirty = voxelize(np.concatenate([points, strays, haze]), opacity, 64)
    assert dirty.pitch == pytest.approx(clean.pitch, rel=0.05)
    assert dirty.solid.sum() == pytest.approx(clean.solid.sum(), rel=0.1)
    sparse = points[::40]
    quats = np.tile([1.0, 0, 0, 0], (len(sparse), 1))
    covered = voxelize(sparse, np.ones(len(sparse)), 64, scales=np.full((len(sparse), 3), 0.05), quats=quats)
    assert covered.solid[tuple(covered.index(np.array([0.5, 0.1, 0.1])))]


def test_too_few_splats_are_explained():
    with pytest.raises(InputError, match="at least two splats"):
        voxelize(np.zeros((1, 3)), np.ones(1))
    assert voxelize(np.zeros((2, 3)), np.ones(2)).solid.any()


def test_enclosure_counts_like_rays():
    solid = np.random.default_rng(0).random((7, 6, 5)) < 0.15
    votes = enclosure(solid)
    for index in np.ndindex(*solid.shape):
        expected = 0
        for step in itertools.product((-1, 0, 1), repeat=3):
            at = np.array(index) + step
            while any(step) and ((at >= 0) & (at < solid.shape)).all():
                if solid[tuple(at)]:
                    expected += 1
                    break
                at = at + step
        assert votes[index] == expected


def test_straight_sight_is_euclidean_and_exact():
    rng = np.random.default_rng(0)
    points = _box((0, 0, 0), (1, 0.4, 0.4), 20000, rng)
    skeleton = _bones(((0.1, 0.2, 0.2), (0.9, 0.2, 0.2)), ((0.1, 0.2, 0.2), (0.3, 0.2, 0.2)))
    got = geodesic_distances(points, np.ones(len(points)), skeleton, 48)
    for b in range(2):
        a, ab = skeleton.heads[b], skeleton.tails[b] - skeleton.heads[b]
        t = np.clip((points - a) @ ab / (ab @ ab), 0, 1)
        expected = np.linalg.norm(points - a - t[:, None] * ab, axis=1)
        # Single voxels at the edges stay empty by chance; the way around them is a little longer.
        assert (np.abs(got[:, b] - expected) > 1e-5).mean() < 0.01
        np.testing.assert_allclose(got[:, b], expected, rtol=0.05)


def test_around_the_corners_of_a_horseshoe():
    """From the top of one leg to a bone in the other: down, across and up along the inner corners."""
    points = _horseshoe()
    skeleton = _bones(((0.9, 0.1, 0.7), (0.9, 0.1, 0.9)))
    distance = geodesic_distances(points, np.ones(len(points)), skeleton, 96)[:, 0]
    top_left = (points[:, 0] < 0.01) & (points[:, 2] > 0.7)
    corner_a, corner_b = np.array([0.2, 0.2]), np.array([0.8, 0.2])  # x, z of the inner corners
    along = np.linalg.norm(points[top_left][:, [0, 2]] - corner_a, axis=1) + 0.6
    along += np.linalg.norm(np.array([0.9, 0.7]) - corner_b)
    expected = np.hypot(along, 0.05)  # a little sideways as well
    error = distance[top_left] / expected - 1
    assert np.abs(error).max() < 0.04
    assert (distance[top_left] > 1.5).all()  # 0.8 through the air


def test_no_longer_than_the_graph_and_no_shorter_than_the_air():
    """Against scipy's Dijkstra over the 26 neighbours, whose paths are at most 1.1 times too long."""
    rng = np.random.default_rng(3)
    solid = rng.random((14, 12, 10)) < 0.6
    solid[5:8, 4:7, 3:6] = True
    grid = VoxelGrid(solid, solid, np.zeros(3), 1.0)
    nodes = np.argwhere(solid)
    skeleton = _bones(((5.5, 5.5, 4.5), (7.5, 5.5, 4.5)))
    source = np.flatnonzero((nodes[:, 0] >= 5) & (nodes[:, 0] <= 7) & (nodes[:, 1:] == [5, 4]).all(axis=1))
    assert len(source) == 3
    gap = np.abs(nodes[:, None] - nodes[None]).max(axis=2) == 1
    i, j = np.nonzero(gap)
    graph = coo_matrix((np.linalg.norm(nodes[i] - nodes[j], axis=1), (i, j)), shape=gap.shape)
    longest = dijkstra(graph, indices=source, min_only=True)
    centres = nodes + 0.5
    got = geodesic_distances(centres, np.ones(len(nodes)), skeleton, grid=grid)[:, 0]
    t = np.clip(centres[:, 0], 5.5, 7.5)
    air = np.linalg.norm(centres - np.column_stack([t, np.full(len(t), 5.5), np.full(len(t), 4.5)]), axis=1)
    reached = np.isfinite(longest)
    assert reached.mean() > 0.9
    assert (got[reached] <= longest[reached] + 1e-4).all()
    assert (got >= air - 1e-4).all()
    assert (longest[reached] <= 1.12 * got[reached] + 0.5).all()
    assert np.isfinite(got).all()


def test_what_is_in_sight_is_what_straight_lines_say():
    """Voxels hand on the sight of the bone from one to the next; here each line is sampled on its own."""
    points = _horseshoe()
    grid = voxelize(points, np.ones(len(points)), 64)
    body = geodesic._Inside.of(grid)
    skeleton = _bones(((0.9, 0.1, 0.3), (0.9, 0.1, 0.9)), ((0.1, 0.1, 0.1), (0.5, 0.1, 0.1)))
    heads, tails = grid.coordinates(skeleton.heads), grid.coordinates(skeleton.tails)
    bones = geodesic._Bones.of(body, heads, tails)
    for bone in range(2):
        length, seen = geodesic._in_sight(body, bones, bone)
        start = body.nodes + 0.5
        axis = tails[bone] - heads[bone]
        t = np.clip((start - heads[bone]) @ axis / (axis @ axis), 0, 1)
        end = heads[bone] + t[:, None] * axis
        np.testing.assert_allclose(length, np.linalg.norm(end - start, axis=1), atol=1e-3)
        truth = np.ones(len(start), bool)
        for part in np.linspace(0, 1, 200):
            truth &= body.node_at(start + part * (end - start)) < body.count
        assert 0.1 < truth.mean() < 0.9
        assert (seen != truth).mean() < 0.03


def test_parts_that_do_not_touch_are_joined_over_the_gap():
    rng = np.random.default_rng(0)
    body = _box((0, 0, 0), (1, 0.4, 0.4), 20000, rng)
    hat = _box((0.2, 0, 0.5), (0.8, 0.4, 0.6), 8000, rng)  # hovers 0.1 above
    points = np.concatenate([body, hat])
    skeleton = _bones(((0.1, 0.2, 0.2), (0.9, 0.2, 0.2)))
    distance = geodesic_distances(points, np.ones(len(points)), skeleton, 64)[:, 0]
    height = points[20000:, 2] - 0.2
    side = np.abs(points[20000:, 1] - 0.2)
    np.testing.assert_allclose(distance[20000:], np.hypot(height, side), rtol=0.15)


def test_bones_in_the_air_and_strays_have_finite_distances():
    points = np.concatenate([_horseshoe(), [[5.0, 5, 5], [0.5, 0.1, 0.7]]])
    skeleton = _bones(
        ((0.1, 0.1, 1.5), (0.1, 0.1, 2)), ((-3, 0, 0), (-3, 0, 1)), ((0.1, 0.1, 0.9), (0.1, 0.1, 1.4))
    )
    distance = geodesic_distances(points, np.ones(len(points)), skeleton, 64)
    assert np.isfinite(distance).all()
    top = np.argmin(np.linalg.norm(points - [0.1, 0.1, 1.0], axis=1))
    assert distance[top, 0] == pytest.approx(0.5, abs=0.05)
    far = np.argmin(np.linalg.norm(points - [0.9, 0.1, 1.0], axis=1))
    assert distance[far, 0] > 2.0  # over the bridge, not through the air
    assert distance[top, 2] < 0.05


def test_scale_and_place_do_not_matter():
    points = _horseshoe(12000)
    skeleton = _bones(((0.1, 0.1, 0.2), (0.1, 0.1, 0.9)), ((0.9, 0.1, 0.2), (0.9, 0.1, 0.9)))
    base = initial_weights_geodesic(points, np.ones(len(points)), skeleton, resolution=64)
    scale, shift = 37.0, np.array([90.0, -20.0, 400.0])
    moved = initial_weights_geodesic(
        scale * points + shift, np.ones(len(points)), skeleton.moved(np.eye(3), scale, shift), resolution=64
    )
    np.testing.assert_allclose(base.sum(axis=1), 1, atol=1e-5)
    assert np.abs(base - moved).mean() < 1e-4
    assert (np.abs(base - moved).max(axis=1) > 0.01).mean() < 0.005


@pytest.mark.parametrize("name", ["q_animals_Cow", "q_animals_Fox", "od_Knight"])
def test_artists_weights_are_met_better_than_by_euclidean_distance(name):
    path = ASSETS / "npz" / f"{name}.npz"
    if not path.exists():
        pytest.skip("needs the shared assets")
    data = np.load(path)
    used = data["bone_used"]
    skeleton = Skeleton(
        tuple(data["bone_names"]), data["bone_parent"], data["bone_head"], data["bone_tail"]
    ).subset(used)
    dense = np.zeros((len(data["verts"]), len(used)))
    dense[data["w_row"], data["w_col"]] = data["w_val"]
    dense = dense[:, used] / dense[:, used].sum(axis=1, keepdims=True)
    cloud, face, bary = sample_mesh(
        data["verts"], data["faces"], data["corner_rgb"] / 255.0, 6000, np.random.default_rng(0)
    )
    truth = np.einsum("nk,nkb->nb", bary, dense[data["faces"][face]])
    through = initial_weights_geodesic(
        cloud.means, cloud.opacities, skeleton, resolution=64, scales=cloud.scales, quats=cloud.quats
    )
    a, ab = skeleton.heads, skeleton.tails - skeleton.heads
    t = np.clip(((cloud.means[:, None] - a) * ab).sum(-1) / (ab * ab).sum(-1), 0, 1)
    d = np.square(cloud.means[:, None] - a - t[..., None] * ab).sum(-1)
    d /= np.square(np.ptp(cloud.means, 0)).sum()
    euclidean = (1 / (0.5 * d + 0.5 * d * d)) ** 2
    euclidean /= euclidean.sum(axis=1, keepdims=True)
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(20, 3))
    transforms = pose_transforms(skeleton, random_poses(skeleton, axes, 20, rng))
    means = cloud.means.astype(np.float64)
    target = skin_points(means, truth, transforms)
    error = [
        np.linalg.norm(skin_points(means, w, transforms) - target, axis=-1).mean()
        for w in (through, euclidean)
    ]
    assert error[0] < 0.9 * error[1]
