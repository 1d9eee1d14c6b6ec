# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo's character: enough splats, true weights that make sense, the same on every run, a looping action."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from needs import WORKER, missing

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def demo():
    """The package `demo`, which is not installed: it lies beside gskin_addon in the repository."""
    sys.path.insert(0, str(ROOT))
    try:
        from demo import blender_tools, character, report, shapes, skeleton
    finally:
        sys.path.remove(str(ROOT))
    return {each.__name__.rpartition(".")[2]: each for each in (blender_tools, character, report, shapes, skeleton)}


@pytest.fixture(scope="module")
def brindle(demo):
    if reason := missing(*WORKER):
        pytest.skip(reason)
    return demo["character"].build()


@pytest.fixture(scope="module")
def splats(demo, brindle):
    return demo["character"].to_splats(brindle, 30_000, seed=0)


def test_true_weights_are_sensible(brindle, splats):
    cloud, truth = splats
    assert cloud.count == 30_000
    assert truth.shape == (30_000, 29)
    assert truth.min() >= 0
    np.testing.assert_allclose(truth.sum(axis=1), 1, atol=1e-9)
    assert truth.max(axis=0).min() > 0.7  # every bone owns some splats

    def of(part):
        return brindle.weights[brindle.part == brindle.parts.index(part)].sum(axis=0)

    head = brindle.bones.index("head")
    for part in ("horns", "eyes", "hair", "fangs"):
        assert of(part)[head] == pytest.approx(of(part).sum())
    moved_by = {name for name, weight in zip(brindle.bones, of("skirt"), strict=True) if weight > 0}
    assert moved_by == {"hips", "thigh.L", "thigh.R"}
    side = cloud.means[:, 0]
    hands = [truth[:, brindle.bones.index(f"hand.{letter}")] > 0.9 for letter in "LR"]
    assert side[hands[0]].min() > 0.4
    assert side[hands[1]].max() < -0.4


def test_splats_look_like_a_capture(splats):
    cloud, _ = splats
    assert cloud.base_colors().std(axis=0).min() > 0.1
    assert 0.5 < np.linalg.norm(cloud.bounds()[1] - cloud.bounds()[0]) < 4
    assert cloud.means[:, 2].min() > -0.05
    assert cloud.scales.max() < 0.05


def test_the_same_every_time(demo, brindle, splats):
    again = demo["character"].build()
    for name in ("verts", "faces", "corner_rgb", "weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(brindle, name))
    cloud, truth = demo["character"].to_splats(again, 30_000, seed=0)
    np.testing.assert_array_equal(cloud.means, splats[0].means)
    np.testing.assert_array_equal(truth, splats[1])


def test_action_loops_and_poses_name_real_bones(demo, brindle):
    names = set(brindle.bones)
    for turns in demo["skeleton"].POSES.values():
        assert set(turns) <= names
    rig = demo["blender_tools"].make_armature("Loop")
    demo["blender_tools"].add_action(rig, "Wave", 48, demo["skeleton"].wave_at)
    scene, hand = bpy.context.scene, rig.pose.bones["hand.L"]
    assert (scene.frame_start, scene.frame_end) == (1, 48)
    seen = []
    for frame in (1, 13, 49):
        scene.frame_set(frame)
        seen.append(np.array(hand.matrix))
    np.testing.assert_allclose(seen[0], seen[2], atol=1e-5)
    assert np.abs(seen[1] - seen[0]).max() > 0.05


def test_shapes_are_closed_and_wound_outwards(demo):
    shapes = demo["shapes"]
    grid = np.stack([*np.meshgrid([0.0, 1, 2], [0.0, 1], indexing="ij"), np.zeros((3, 2))], axis=2)
    solids = {
        "ellipsoid": shapes.ellipsoid((1, 2, 3), (1, 2, 3)),
        "tube": shapes.tube([(0, 0, 0), (0, 0, 1), (0, 1, 2)], [0.3, 0.2, 0.1]),
        "torus": shapes.torus((0, 0, 0), (2, 1.5), (0.2, 0.3)),
        "cloth": shapes.cloth(grid, 0.1),
    }
    volumes = {}
    for name, (verts, faces) in solids.items():
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        merged = np.unique(np.round(verts, 9), axis=0, return_inverse=True)[1].reshape(-1)
        edges = merged[edges]
        edges = edges[edges[:, 0] != edges[:, 1]]  # poles
        one_way = {tuple(edge) for edge in edges.tolist()}
        assert all((b, a) in one_way for a, b in one_way), name
        a, b, c = verts[faces].transpose(1, 0, 2)
        volumes[name] = np.einsum("nd,nd->n", a, np.cross(b, c)).sum() / 6
    assert volumes["ellipsoid"] == pytest.approx(4 / 3 * np.pi * 6, rel=0.03)
    assert volumes["torus"] == pytest.approx(2 * np.pi * 1.75 * np.pi * 0.06, rel=0.05)
    assert volumes["tube"] > 0
    assert abs(volumes["cloth"]) == pytest.approx(0.2, rel=1e-6)


def test_report_knows_better_from_worse(demo, brindle, splats):
    report = demo["report"]
    from gskin_addon.core.rig.skeleton import Skeleton

    bones = demo["skeleton"].bones()
    names = list(bones)
    skeleton = Skeleton(
        tuple(names),
        np.array([names.index(parent) if parent in bones else -1 for parent, _, _ in bones.values()]),
        np.array([head for _, head, _ in bones.values()]),
        np.array([tail for _, _, tail in bones.values()]),
    )
    cloud, truth = splats[0].select(slice(None, None, 10)), splats[1][::10].astype(np.float32)
    rigid = np.zeros_like(truth)
    rigid[np.arange(len(truth)), truth.argmax(axis=1)] = 1
    scores = report.score(cloud, skeleton, truth, {"initial": rigid, "learned": truth})
    assert scores["learned"].position == 0
    assert scores["initial"].position > 0.01
    assert scores["initial"].psnr < 60 < scores["learned"].psnr
    assert "(-100 %)" in report.table(scores)
