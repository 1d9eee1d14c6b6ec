# SPDX-License-Identifier: GPL-3.0-or-later
"""Kinship and the numbers of bones, on a small family tree."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.learned.tree import BONE_FEATURES, RELATIONS, ancestry, bone_features, kinship

#        0 - 1 - 2 - 3
#         \  |    \ 4
#          5 6
PARENTS = np.array([-1, 0, 1, 2, 2, 0, 1])


def test_ancestry_counts_the_steps_up():
    up = ancestry(PARENTS)
    assert up[3].tolist() == [3, 2, 1, 0, -1, -1, -1]
    assert up[5].tolist() == [1, -1, -1, -1, -1, 0, -1]


def test_every_kind_of_kin_is_named():
    kin = kinship(PARENTS)

    def of(a: int, b: int) -> str:
        return RELATIONS[kin[a, b]]

    assert of(2, 2) == "self"
    assert (of(2, 1), of(1, 2)) == ("parent", "child")
    assert (of(2, 0), of(0, 2)) == ("grandparent", "grandchild")
    assert (of(3, 0), of(0, 3)) == ("ancestor", "descendant")
    assert of(3, 4) == of(4, 3) == "sibling"
    assert (of(2, 5), of(5, 2)) == ("uncle", "nephew")
    assert of(3, 5) == "distant"
    assert RELATIONS[kinship(np.array([-1, 0, 0, 1, 2]))[3, 4]] == "cousin"
    assert RELATIONS[kinship(np.array([-1, -1]))[0, 1]] == "distant"


def test_bone_numbers_have_no_unit_and_ignore_turns():
    rng = np.random.default_rng(0)
    heads = rng.normal(size=(7, 3))
    skeleton = Skeleton(tuple("abcdefg"), PARENTS, heads, heads + rng.normal(size=(7, 3)))
    base = bone_features(skeleton, skeleton.tails, 3.0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]  # mirrors as well, half of the time
    for matrix in (turn, turn * [-1, 1, 1]):
        moved = skeleton.moved(matrix, 40.0, (5, 6, 7))
        np.testing.assert_allclose(bone_features(moved, moved.tails, 120.0), base, atol=1e-5)
    named = dict(zip(BONE_FEATURES, base.T, strict=True))
    assert named["root"].tolist() == [1, 0, 0, 0, 0, 0, 0]
    assert named["leaf"].tolist() == [0, 0, 0, 1, 1, 1, 1]
    np.testing.assert_allclose(named["depth"] * 8, [0, 1, 2, 3, 3, 1, 2])
    np.testing.assert_allclose(np.exp(named["subtree"]) * 7, [7, 5, 3, 1, 1, 1, 1], rtol=1e-5)
