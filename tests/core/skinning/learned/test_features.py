# SPDX-License-Identifier: GPL-3.0-or-later
"""The network's input: against plain loops in double precision, and what it must not depend on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.rig.segments import bone_segments
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.learned.describe import describe_body
from gskin_addon.core.skinning.learned.features import NAMES, TOKENS, Reach, describe
from gskin_addon.core.training.prior import creatures


@pytest.fixture(scope="module")
def scene():
    """A creature with everything that `describe` wants."""
    biped = creatures.generate_creature(np.random.default_rng(5), creatures.KINDS[0][0])
    return biped.skeleton, describe_body(biped.cloud, biped.skeleton, limit=800)


def described(scene, points=None, skeleton=None, factor=1.0, normals=None, out=None, rows=None):
    base, body = scene
    own = body.reach
    reach = Reach(own.distances * factor, own.faced * factor, own.heat, own.diffuse, own.hard, own.plain)
    return describe(
        body.points if points is None else points, body.normals if normals is None else normals,
        body.out if out is None else out, skeleton or base, reach, body.parts, body.size * factor, rows=rows,
    )  # fmt: skip


def test_values_match_plain_loops(scene):
    skeleton, body = scene
    normals, reach = body.normals, body.reach
    got = described(scene)
    segments = bone_segments(skeleton)
    assert got.values.shape == (len(body.points), TOKENS, len(NAMES))
    assert np.isfinite(got.values).all()
    size, floor = body.size, 1e-3 * body.size

    def near_of(n, b):
        best = (np.inf, 0.0, 0.0, 0.0)
        for start, end, bone in zip(segments.starts, segments.ends, segments.bone, strict=True):
            if bone == b:
                axis = end - start
                t = (body.points[n] - start) @ axis / (axis @ axis)
                q = start + np.clip(t, 0, 1) * axis
                way = max(float(np.linalg.norm(body.points[n] - q)), 1e-12)
                facing, outward = ((body.points[n] - q) @ side[n] / way for side in (normals, body.out))
                best = min(best, (way, float(t), abs(float(facing)), float(outward)))
        return best

    children = [np.flatnonzero(skeleton.parents == b) for b in range(skeleton.count)]
    below = [set() for _ in children]
    for b in reversed(range(skeleton.count)):
        below[b] = {b}.union(*(below[c] for c in children[b]))
    loose = body.parts.labels[:, 2]
    nearest = reach.distances.argmin(axis=1)
    rng = np.random.default_rng(0)
    for n in rng.integers(0, len(body.points), 12):
        order = np.argsort(reach.distances[n], kind="stable")[:TOKENS]
        assert got.bone[n][: len(order)].tolist() == order.tolist()
        for k in (0, 1, len(order) - 1):
            b = int(order[k])
            value = dict(zip(NAMES, got.values[n, k].astype(float), strict=True))
            way, t, facing, outward = near_of(n, b)
            same = loose == loose[n]
            expected = {
                "straight": np.log(max(way, floor) / size),
                "through": np.log(max(reach.distances[n, b], floor) / size),
                "through over nearest": np.log(
                    max(reach.distances[n, b], floor) / max(reach.distances[n].min(), floor)
                ),
                "along": np.clip(t, -2, 3),
                "facing": facing,
                "outward": outward,
                "faced": np.clip(np.log(reach.faced[n, b] / size), -8, 3),
                "faced over nearest": np.clip(np.log(reach.faced[n, b] / reach.faced[n].min()), 0, 6),
                "faced falloff": np.log(reach.faced[n, b] ** -4 / (reach.faced[n] ** -4.0).sum() + 1e-3),
                "hard heat": np.log(reach.hard[n, b] + 1e-3),
                "plain heat": np.log(reach.plain[n, b] + 1e-3),
                "thick": np.linalg.norm(body.out[n]),
                "rank": k / 16,
                "heat": np.log(reach.heat[n, b] + 1e-3),
                "diffuse heat": np.log(reach.diffuse[n, b] + 1e-3),
                "owned": np.log((nearest == b).mean() + 1e-4),
                "heat of kin below": np.log(sum(reach.heat[n, c] for c in below[b]) + 1e-3),
                "heat loose": np.log(reach.heat[same, b].mean() + 1e-3),
                "nearest loose": np.log((nearest[same] == b).mean() + 1e-3),
                "children": min(len(children[b]), 6) / 3,
                "loose size": np.log(same.mean()),
                "bones": np.log(skeleton.count) / 3,
            }
            parent = int(skeleton.parents[b])
            expected["heat of parent"] = np.log((reach.heat[n, parent] if parent >= 0 else 0) + 1e-3)
            for name, want in expected.items():
                assert value[name] == pytest.approx(want, abs=2e-3), (name, n, b)


def test_turning_moving_scaling_and_mirroring_change_nothing(scene):
    skeleton, body = scene
    base = described(scene)
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flips = rng.choice([-1.0, 1.0], (len(body.points), 1))
    for matrix in (turn, turn @ np.diag([-1.0, 1, 1])):
        there = described(
            scene, 30 * body.points @ matrix.T + [3, 4, 5], skeleton.moved(matrix, 30.0, (3, 4, 5)), 30.0,
            body.normals @ matrix.T * flips, body.out @ matrix.T,
        )  # fmt: skip
        np.testing.assert_array_equal(there.bone, base.bone)
        np.testing.assert_allclose(there.values, base.values, atol=5e-3)


def test_order_of_bones_and_splats_is_of_no_importance(scene):
    skeleton, body = scene
    base = described(scene)
    rng = np.random.default_rng(2)
    # Another order in which parents still come first.
    key = rng.random(skeleton.count)
    for bone in range(skeleton.count):
        if skeleton.parents[bone] >= 0:
            key[bone] = key[skeleton.parents[bone]] + rng.random()
    order = np.argsort(key)
    place = np.argsort(order)
    parents = np.where(skeleton.parents[order] >= 0, place[skeleton.parents[order]], -1)
    other = Skeleton(
        tuple(skeleton.names[b] for b in order), parents, skeleton.heads[order], skeleton.tails[order]
    )
    mixed = describe(
        body.points, body.normals, body.out, other, body.reach.pick((slice(None), order)), body.parts, body.size
    )
    count = min(TOKENS, skeleton.count)
    distinct = np.sort(body.reach.distances, axis=1)
    clear = (np.diff(distinct, axis=1)[:, :count] > 1e-6 * body.size).all(axis=1)  # no ties
    np.testing.assert_array_equal(order[mixed.bone[clear, :count]], base.bone[clear, :count])
    np.testing.assert_allclose(mixed.values[clear], base.values[clear], atol=2e-3)
    np.testing.assert_array_equal(mixed.relation, base.relation[np.ix_(order, order)])
    np.testing.assert_array_equal(mixed.role, base.role[order])

    rows = rng.permutation(len(body.points))
    back = np.argsort(rows)
    parts = replace(
        body.parts,
        near=tuple(back[near[rows]] for near in body.parts.near),
        labels=body.parts.labels[rows],
    )
    shuffled = describe(
        body.points[rows], body.normals[rows], body.out[rows], skeleton, body.reach.pick(rows), parts, body.size
    )
    np.testing.assert_array_equal(shuffled.bone, base.bone[rows])
    np.testing.assert_allclose(shuffled.values, base.values[rows], atol=2e-3)


def test_some_rows_are_described_as_among_all(scene):
    rows = np.array([3, 70, 200])
    some, every = described(scene, rows=rows), described(scene)
    np.testing.assert_array_equal(some.bone, every.bone[rows])
    np.testing.assert_array_equal(some.values, every.values[rows])
