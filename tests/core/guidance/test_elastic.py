# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance import create_provider
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.elastic import ElasticBody
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.skinning.geodesic import body_distances
from gskin_addon.core.skinning.heat import BoneHeat
from gskin_addon.core.skinning.node_graph import build_graph
from tests.helpers.limb import make_limb


@pytest.fixture(scope="module")
def limb():
    return make_limb(2500)


@pytest.fixture(scope="module")
def heat(limb):
    return BoneHeat(limb.cloud, body_distances(limb.cloud, limb.skeleton), nodes=800)


@pytest.fixture(scope="module")
def body(limb, heat):
    return ElasticBody(limb.cloud, heat)


def bend(limb, angle):
    rotations = np.tile(np.eye(3), (1, 3, 1, 1))
    rotations[0, 1] = Rotation.from_rotvec([0, angle, 0]).as_matrix()
    return pose_transforms(limb.skeleton, rotations)


def test_rest_pose_stays(limb, body):
    (posed,) = body.pose(np.tile(np.eye(4), (1, 3, 1, 1)))
    np.testing.assert_allclose(posed.means, limb.cloud.means, atol=1e-5)
    np.testing.assert_allclose(np.abs((posed.quats * limb.cloud.quats).sum(1)), 1, atol=1e-5)


def test_common_rigid_motion_is_followed(limb, body):
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec([0.4, -0.2, 1.0]).as_matrix(), (1, 2, 3)
    (posed,) = body.pose(np.tile(motion, (1, 3, 1, 1)))
    np.testing.assert_allclose(posed.means, limb.cloud.means @ motion[:3, :3].T + motion[:3, 3], atol=1e-4)


def test_a_bend_follows_the_bones_and_keeps_edges(limb, body):
    transforms = bend(limb, 0.8)
    (posed,) = body.pose(transforms)
    truth = skin_points(limb.cloud.means, limb.weights, transforms[0])
    assert np.linalg.norm(posed.means - truth, axis=1).mean() < 0.03  # the tube is 0.24 thick, the tip moves 1.5
    after, before = (Rotation.from_quat(c.quats[:, [1, 2, 3, 0]]) for c in (posed, limb.cloud))
    turned = after * before.inv()
    tip = limb.cloud.means[:, 0] > 1.6
    np.testing.assert_allclose(turned[tip].as_rotvec().mean(0), [0, 0.8, 0], atol=0.05)


def test_heat_weights_are_weights_near_the_truth(limb, heat):
    weights = heat.weights()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)
    assert weights.min() >= 0
    assert (weights.argmax(1) == limb.weights.argmax(1)).mean() > 0.95


def test_graph_is_connected_and_does_not_jump_gaps():
    """Two parallel rods joined at one end: no edge may lead across the slit between them."""
    t = np.linspace(0, 1, 300)
    left = np.stack([t, np.zeros(300), np.zeros(300)], 1)
    right = left + (0, 0.02, 0)
    means = np.concatenate([left, right])
    # Distance to a bone at the far end of the left rod, through the joint at x = 0.
    profile = np.concatenate([1 - t, 1 + t])[:, None]
    graph = build_graph(means, profile, 600)
    a, b = graph.edges.T
    across = (graph.nodes[a] < 300) != (graph.nodes[b] < 300)
    assert np.all(means[graph.nodes[a[across]], 0] < 0.1)
    free = means[:, 0] > 0.1
    side = graph.nodes[graph.anchor] < 300
    own = np.arange(600)[:, None] < 300
    assert np.all((side == own)[free] | (graph.anchor_weight[free] == 0))
    count = len(graph.nodes)
    matrix = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    assert connected_components(matrix, directed=False)[0] == 1


def test_separate_pieces_are_bridged():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.normal(size=(200, 3)) * 0.1 + (4 * k, 0, 0) for k in range(4)])
    graph = build_graph(means, np.zeros((800, 1)), 400)
    a, b = graph.edges.T
    count = len(graph.nodes)
    matrix = sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    assert connected_components(matrix, directed=False)[0] == 1
    np.testing.assert_allclose(graph.anchor_weight.sum(1), 1, atol=1e-9)


def test_provider_renders_every_signal(limb):
    cameras = paper_views(*limb.cloud.bounds(), 64)
    signals = make_signals(limb.skeleton, cameras, 3, np.random.default_rng(0))
    context = GuidanceContext(
        limb.cloud, limb.skeleton, limb.weights, body_distances(limb.cloud, limb.skeleton)
    )
    images = list(create_provider("elastic", context).images(signals))
    assert len(images) == len(signals) == 12
    assert all(i.shape == (64, 64, 3) and i.dtype == np.uint8 and (i < 250).any() for i in images)


def test_unknown_guidance_names_the_choices(limb):
    context = GuidanceContext(limb.cloud, limb.skeleton, limb.weights, limb.weights)
    with pytest.raises(InputError, match="elastic, flux2, flux_repair"):
        create_provider("magic", context)


@pytest.mark.parametrize(
    ("options", "words"),
    [({}, "oracle_weights"), ({"oracle_weights": "no/such.npz"}, "no/such.npz")],
)
def test_oracle_says_what_it_lacks(limb, options, words):
    context = GuidanceContext(limb.cloud, limb.skeleton, limb.weights, limb.weights, options=options)
    with pytest.raises(InputError, match=words):
        create_provider("oracle", context)


def test_oracle_refuses_weights_of_another_cloud(limb, tmp_path):
    np.savez(tmp_path / "w.npz", weights=limb.weights[:-1])
    context = GuidanceContext(
        limb.cloud, limb.skeleton, limb.weights, limb.weights, options={"oracle_weights": str(tmp_path / "w.npz")}
    )
    with pytest.raises(InputError, match="same splats and armature"):
        create_provider("oracle", context)


def oracle(limb, folder, index=None, **arrays):
    np.savez(folder / "w.npz", **arrays)
    given = {"index": index, "whole": limb.cloud.count, "options": {"oracle_weights": str(folder / "w.npz")}}
    return create_provider("oracle", GuidanceContext(limb.cloud, limb.skeleton, limb.weights, limb.weights, **given))


@pytest.mark.parametrize("change", [lambda w: w * np.nan, lambda w: -w, lambda w: 0 * w, lambda w: 2 * w])
def test_oracle_refuses_numbers_that_are_no_weights(limb, tmp_path, change):
    with pytest.raises(InputError, match="negative or not finite, or do not sum to 1"):
        oracle(limb, tmp_path, weights=change(limb.weights))


@pytest.mark.parametrize("weights", [3.0, np.zeros((2, 3, 4)), np.full((4, 3), "a"), np.zeros((4, 3), complex)])
def test_oracle_refuses_what_is_no_table(limb, tmp_path, weights):
    with pytest.raises(InputError, match="not a table of numbers"):
        oracle(limb, tmp_path, weights=weights)


def test_oracle_takes_no_larger_cloud_for_this_one(limb, tmp_path):
    twice = np.concatenate([limb.weights, limb.weights])
    with pytest.raises(InputError, match="same splats and armature"):
        oracle(limb, tmp_path, np.arange(limb.cloud.count), weights=twice)


def test_oracle_heeds_the_names_of_bones(limb, tmp_path):
    names = np.array(limb.skeleton.names)
    known = oracle(limb, tmp_path, weights=limb.weights[:, ::-1], bones=names[::-1])
    np.testing.assert_array_equal(known._weights, limb.weights)
    with pytest.raises(InputError, match="other bones than the armature"):
        oracle(limb, tmp_path, weights=limb.weights, bones=np.char.add(names, "_"))
