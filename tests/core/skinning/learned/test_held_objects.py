# SPDX-License-Identifier: GPL-3.0-or-later
"""What a hand holds follows the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from gskin_addon.core.rig.quaternion import axis_angle_to_matrix
from gskin_addon.core.rig.segments import bone_segments
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.learned.held_objects import find_hands, hold

SIZE = 4.0


@dataclass
class Figure:
    """An arm along x with fingers at its end, a club across them; weights: as by the nearest bone."""

    skeleton: Skeleton
    points: np.ndarray
    club: np.ndarray
    weights: np.ndarray

    def bone(self, name: str) -> int:
        return self.skeleton.names.index(name)


def make_figure(*, spread: float = 0.0, tool: bool = False, club: float = 1.0) -> Figure:
    """spread: of the fingers' first joints; tool: a lone bone for the club; club: its length."""
    names, parents = ["root", "upper", "lower"], [-1, 0, 1]
    heads = [np.zeros(3), np.array([0, 0, 1.0]), np.array([0.8, 0, 1.0])]
    tails = [np.array([0, 0, 1.0]), heads[2], np.array([1.6, 0, 1.0])]

    def add(name, parent, head, tail):
        names.append(name)
        parents.append(parent)
        heads.append(head)
        tails.append(tail)
        return len(names) - 1

    wrist, flesh = tails[2], []
    for finger, y in (("pinky", 0.8), ("middle", 0.0), ("thumb", -1.5)):
        way = np.array([1.0, y, 0.0]) / np.hypot(1, y)
        at, last = wrist + [0, spread * y, 0], 2
        for joint in range(2):
            last = add(f"{finger}{joint}", last, at, at + 0.12 * way)
            at = at + 0.12 * way
        flesh += [wrist + [0, spread * y, 0] + t * way for t in np.linspace(0.02, 0.24, 12)]
    if tool:
        add("tool", 2, wrist, wrist + [0.0, -0.05, 0.1])
    skeleton = Skeleton(tuple(names), np.array(parents), np.array(heads), np.array(tails))
    arm = [heads[2] + t * (wrist - heads[2]) for t in np.linspace(0, 1, 20)]
    grip = wrist + 0.15 * np.array([1.0, -1.5, 0]) / np.hypot(1, 1.5) + [0, 0, 0.03]
    stick = [grip + [0, 0, t] for t in np.linspace(0, club, 60)]
    points = np.array([*arm, *flesh, *stick])
    weights = np.zeros((len(points), len(names)))
    middles = (skeleton.heads + skeleton.tails) / 2
    nearest = np.linalg.norm(points[:, None] - middles, axis=-1)[:, 2:].argmin(1) + 2
    weights[np.arange(len(points)), nearest] = 1
    held = np.arange(len(points)) >= len(points) - 60
    weights[held] = 0
    weights[held, names.index("tool" if tool else "thumb1")] = 0.9
    weights[held, names.index("lower")] = 0.1
    return Figure(skeleton, points, held, weights)


@pytest.mark.parametrize(("spread", "palm"), [(0.0, "middle0"), (0.08, "lower")])
def test_a_club_follows_one_bone_and_the_rest_stays(spread, palm):
    figure = make_figure(spread=spread)
    before = figure.weights.copy()
    got = hold(figure.weights, figure.points, figure.skeleton, SIZE)
    np.testing.assert_array_equal(figure.weights, before)
    np.testing.assert_allclose(got.sum(axis=1), 1)
    far = figure.club & (figure.points[:, 2] > 1.1)
    np.testing.assert_allclose(got[far][:, figure.bone("thumb1")], 0)
    assert got[far][:, figure.bone(palm)].min() >= 0.9
    np.testing.assert_array_equal(got[~figure.club], before[~figure.club])


def test_the_same_turned_and_scaled():
    figure = make_figure()
    turn = 7.0 * axis_angle_to_matrix(np.array([[0.6, 0.0, 0.8]]), np.array([1.1]))[0]
    bones = figure.skeleton
    moved = Skeleton(bones.names, bones.parents, bones.heads @ turn.T, bones.tails @ turn.T)
    plain = hold(figure.weights, figure.points, bones, SIZE)
    np.testing.assert_allclose(hold(figure.weights, figure.points @ turn.T, moved, 7.0 * SIZE), plain)


def test_a_tool_with_its_own_bone_keeps_it():
    figure = make_figure(tool=True)
    got = hold(figure.weights, figure.points, figure.skeleton, SIZE)
    assert got is figure.weights


def test_a_long_nail_stays_with_its_finger():
    """It reaches off the flesh, but not a finger's length."""
    figure = make_figure(club=0.2)
    assert hold(figure.weights, figure.points, figure.skeleton, SIZE) is figure.weights


def test_no_hands():
    """Two chains, long limbs, and a root with many children are none."""
    figure = make_figure()
    two = figure.skeleton.subset(np.array([not name.startswith("pinky") for name in figure.skeleton.names]))
    hands = find_hands(figure.skeleton, bone_segments(figure.skeleton), SIZE)
    assert [figure.skeleton.names[hand.palm] for hand in hands] == ["middle0"]
    assert sorted(figure.skeleton.names[bone] for bone in hands[0].fingers) == sorted(figure.skeleton.names[3:])
    assert hands[0].reach == pytest.approx(0.24)
    assert find_hands(two, bone_segments(two), SIZE) == []
    assert find_hands(figure.skeleton, bone_segments(figure.skeleton), SIZE / 4) == []
    root = figure.skeleton.subset(np.arange(figure.skeleton.count) > 2)
    assert find_hands(root, bone_segments(root), SIZE) == []
