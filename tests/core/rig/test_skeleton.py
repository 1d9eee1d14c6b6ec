# SPDX-License-Identifier: GPL-3.0-or-later
"""The skeleton's meaning, its JSON form and its error messages."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.skeleton import Skeleton, parents_first


def tree() -> Skeleton:
    heads = np.array([[0, 0, 0], [0, 0, 1], [0.5, 0, 2], [0, 0, 1], [0, 1, 2.0]])
    tails = np.array([[0, 0, 1], [0.5, 0, 2], [1, 0, 2], [0, 1, 2], [0, 2, 2.0]])
    return Skeleton(("hips", "arm", "hand", "neck", "head"), np.array([-1, 0, 1, 0, 3]), heads, tails)


def test_defaults_children_and_lengths():
    s = tree()
    s.validate()
    np.testing.assert_array_equal(s.rest[2, :3, 3], s.heads[2])
    np.testing.assert_array_equal(s.rest[2, :3, :3], np.eye(3))
    assert s.children(0).tolist() == [1, 3]
    assert s.roots.tolist() == [0]
    np.testing.assert_allclose(s.lengths, [1, np.sqrt(1.25), 0.5, np.sqrt(2), 1])


def test_json_round_trip_is_exact():
    s = tree().moved(np.eye(3), 1 / 3, (0.1, 1e-9, 7e5))
    back = Skeleton.from_json(s.to_json())
    assert back.names == s.names
    for field in ("parents", "heads", "tails", "rest"):
        np.testing.assert_array_equal(getattr(back, field), getattr(s, field))


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"names": ["a"], "parents": [-1], "heads": [[0, 0]], "tails": [[0, 0, 1]]}']
)
def test_broken_json_is_named(text):
    with pytest.raises(InputError, match=r"job/skeleton\.json is not a skeleton"):
        Skeleton.from_json(text, "job/skeleton.json")


def test_subset_hangs_orphans_on_kept_ancestors():
    s = tree().subset([0, 2, 4])
    assert s.names == ("hips", "hand", "head")
    assert s.parents.tolist() == [-1, 0, 0]
    assert tree().subset(np.array([False, True, True, True, True])).parents.tolist() == [-1, 0, -1, 2]


def test_moved_maps_rest_frames_like_points():
    r = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    s = tree().moved(r, 2.0, (1, 2, 3))
    np.testing.assert_allclose(s.tails[4], 2 * r @ [0, 2, 2] + [1, 2, 3])
    np.testing.assert_allclose(s.rest[:, :3, 3], s.heads)
    np.testing.assert_allclose(s.rest[1, :3, :3], r)


def replaced(**values: object) -> Skeleton:
    return dataclasses.replace(tree(), **values)


@pytest.mark.parametrize(
    ("skeleton", "message"),
    [
        (Skeleton((), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))), "Rig has no deform bones"),
        (replaced(names=("hips", "arm", "arm", "neck", "head")), "two bones named 'arm'"),
        (replaced(tails=np.where(np.arange(5)[:, None] == 2, tree().heads, tree().tails)), r"'hand'.*zero"),
        (replaced(parents=np.array([-1, 2, 0, 0, 3])), "'arm' of Rig comes before its parent"),
        (replaced(parents=np.array([-1, 0, 2, 0, 3])), "'hand' of Rig comes before its parent"),
        (replaced(heads=tree().heads * [[1], [1], [1], [np.nan], [1]]), "'neck'.*NaN"),
    ],
)
def test_validate_names_the_bone_and_the_remedy(skeleton, message):
    with pytest.raises(InputError, match=message):
        skeleton.validate("Rig")


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="heads have shape"):
        Skeleton(("a", "b"), np.array([-1, 0]), np.zeros((3, 3)), np.zeros((2, 3)))


def test_parents_first():
    assert parents_first([-1, 0, 1, 0]).tolist() == [0, 1, 2, 3]
    parents = [2, 0, -1, 1]
    order = parents_first(parents).tolist()
    assert all(order.index(p) < order.index(b) for b, p in enumerate(parents) if p >= 0)
    with pytest.raises(ValueError, match="cycle"):
        parents_first([1, 0])
