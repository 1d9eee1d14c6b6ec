# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.rig.segments import bone_segments, invented_tails, tail_scale
from gskin_addon.core.rig.skeleton import Skeleton
from tests.helpers.limb import make_limb


def figure(tails=None) -> Skeleton:
    """A trunk of two bones, two legs of two, and a head."""
    names = ("hips", "chest", "head", "thigh.L", "shin.L", "thigh.R", "shin.R")
    parents = [-1, 0, 1, 0, 3, 0, 5]
    heads = [(0, 0, 10), (0, 0, 13), (0, 0, 16), (1, 0, 9), (1, 0, 5), (-1, 0, 9), (-1, 0, 5)]
    honest = [(0, 0, 13), (0, 0, 16), (0, 0, 19), (1, 0, 5), (1, 0, 1), (-1, 0, 5), (-1, 0, 1)]
    return Skeleton(names, np.array(parents), np.array(heads), np.array(honest if tails is None else tails))


def spans(skeleton: Skeleton, name: str) -> list[tuple[float, ...]]:
    segments = bone_segments(skeleton)
    own = segments.bone == skeleton.names.index(name)
    assert (segments.starts[own] == skeleton.heads[skeleton.names.index(name)]).all()
    return sorted(tuple(end) for end in segments.ends[own])


def test_honest_bones_are_themselves():
    skeleton = figure()
    segments = bone_segments(skeleton)
    np.testing.assert_array_equal(segments.starts, skeleton.heads)
    np.testing.assert_array_equal(segments.ends, skeleton.tails)
    assert invented_tails(skeleton) == (False, False)


@pytest.mark.parametrize("way", [(0.05, 0, 0), (0, 3, 0)], ids=["stubs", "turned aside"])
def test_invented_tails_give_way_to_the_next_joints(way):
    honest = figure()
    skeleton = replace(honest, tails=honest.heads + way)
    assert invented_tails(skeleton) == (way[0] > 0, way[1] > 0)
    assert spans(skeleton, "hips") == [(-1, 0, 9), (0, 0, 13), (1, 0, 9)]
    assert spans(skeleton, "chest") == [(0, 0, 16)]
    assert spans(skeleton, "thigh.L") == [(1, 0, 5)]


def test_a_leaf_turned_aside_goes_on_as_its_parent_went():
    honest = figure()
    skeleton = replace(honest, tails=honest.heads + (0, 3, 0))
    assert spans(skeleton, "head") == [(0, 0, 19)]
    assert spans(skeleton, "shin.R") == [(-1, 0, 1)]


def test_a_short_leaf_keeps_its_direction():
    limb = make_limb(10)
    stubs = replace(limb.skeleton, tails=limb.skeleton.heads + (0.01, 0, 0))
    segments = bone_segments(stubs)
    np.testing.assert_array_equal(segments.bone, [0, 1, 2])
    np.testing.assert_allclose(segments.ends, limb.skeleton.tails)
    np.testing.assert_allclose(bone_segments(limb.skeleton).ends, limb.skeleton.tails)


def test_a_leaf_is_no_longer_than_its_own_way():
    """A foot beside a root whose other child is far away."""
    heads = np.array([(0, 0, 0), (0, 0, 100), (2, 0, 0)], float)
    skeleton = Skeleton(("root", "hips", "foot"), np.array([-1, 0, 0]), heads, heads + (0.01, 0, 0))
    assert spans(skeleton, "foot") == [(4, 0, 0)]


def test_one_short_bone_among_honest_ones_stays():
    tails = figure().tails.copy()
    tails[0] = (0, 0, 10.1)
    assert spans(figure(tails), "hips") == [(0, 0, 10.1)]


def test_a_head_with_a_jaw_is_no_sign_of_invented_tails():
    figure_ = figure()
    jaw = Skeleton(
        (*figure_.names, "jaw"),
        np.append(figure_.parents, 2),
        np.concatenate([figure_.heads, [(0, -1, 16)]]),
        np.concatenate([figure_.tails, [(0, -2, 16)]]),
    )
    np.testing.assert_array_equal(bone_segments(jaw).ends, jaw.tails)


def test_a_leaf_without_length_goes_on_as_its_parent_went():
    skeleton = figure()
    tails = skeleton.tails.copy()
    tails[2] = skeleton.heads[2]
    assert spans(replace(skeleton, tails=tails), "head") == [(0, 0, 19)]


def test_bones_without_length_and_children_in_one_place():
    heads = np.zeros((3, 3))
    skeleton = Skeleton(("a", "b", "c"), np.array([-1, 0, 0]), heads, heads)
    segments = bone_segments(skeleton)
    np.testing.assert_array_equal(segments.bone, [0, 1, 2])
    assert np.isfinite(segments.ends).all()


def scaled(skeleton: Skeleton, factor: float) -> Skeleton:
    return replace(skeleton, tails=skeleton.heads + factor * (skeleton.tails - skeleton.heads))


@pytest.mark.parametrize("factor", [0.01, 0.3, 0.9, 2.5, 100])
def test_lengths_wrong_by_one_factor_are_set_right(factor):
    """Leaves too, which no child would tell; one bone of another length does not matter."""
    honest = figure()
    assert tail_scale(honest) == 1
    wrong = scaled(honest, factor)
    assert tail_scale(wrong) == pytest.approx(factor)
    np.testing.assert_allclose(bone_segments(wrong).ends, honest.tails, atol=1e-9)
    odd = wrong.tails.copy()
    odd[1] = wrong.heads[1] + 0.7 * (wrong.tails[1] - wrong.heads[1])
    np.testing.assert_allclose(bone_segments(replace(wrong, tails=odd)).ends[2:], honest.tails[2:], atol=1e-9)


def test_too_few_bones_that_agree_show_no_factor():
    limb = make_limb(10)  # two bones with a child
    assert tail_scale(scaled(limb.skeleton, 2.5)) == 1
    honest = figure()
    tails = honest.tails.copy()
    for number, bone in enumerate((0, 1, 3, 5)):  # all bones with children, each by a factor of its own
        tails[bone] = honest.heads[bone] + 1.5**number * 0.4 * (tails[bone] - honest.heads[bone])
    assert tail_scale(replace(honest, tails=tails)) == 1


def test_what_is_too_long_when_set_right_spans_to_its_children():
    honest = figure()
    tails = honest.tails.copy()
    tails[0] = honest.heads[0] + (0, 0, 9)
    assert tail_scale(scaled(replace(honest, tails=tails), 0.01)) == pytest.approx(0.01)
    assert spans(scaled(replace(honest, tails=tails), 0.01), "hips") == [(-1, 0, 9), (0, 0, 13), (1, 0, 9)]
    assert spans(replace(honest, tails=tails), "hips") == [(0, 0, 19)]  # so its artist made it


def test_a_root_that_leads_elsewhere_spans_to_its_only_child():
    honest = figure()
    names, parents = ("handle", *honest.names), np.array([-1, *(honest.parents + 1)])
    heads, tails = np.vstack([(0, 4, 0), honest.heads]), np.vstack([(0, 4, 9), honest.tails])
    skeleton = Skeleton(names, parents, heads, tails)
    assert spans(skeleton, "handle") == [(0, 4, 9)]
    assert spans(scaled(skeleton, 0.01), "handle") == [(0, 0, 10)]


def test_a_factor_does_not_hang_on_place_turn_or_size():
    honest = scaled(figure(), 2.5)
    turn = 0.03 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    moved = replace(honest, heads=honest.heads @ turn.T + 7, tails=honest.tails @ turn.T + 7)
    assert tail_scale(moved) == pytest.approx(2.5)
