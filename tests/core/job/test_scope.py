# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from worker_jobs import write_scope

from gskin_addon.core.errors import InputError
from gskin_addon.core.job.scope import Scope, read_scope, scope_file


def present(rows=5, bones=2):
    weights = np.random.default_rng(0).random((rows, bones)).astype(np.float32)
    return weights / weights.sum(axis=1, keepdims=True)


def test_a_scope_comes_back_as_it_was(tmp_path):
    scope = Scope(present(), np.array([1, 3]), np.array([0, 1, 1, 2, 0]))
    name = write_scope(tmp_path, scope)
    back = read_scope(tmp_path / name, 5, 2)
    np.testing.assert_array_equal(back.present, scope.present)
    np.testing.assert_array_equal(back.only, scope.only)
    np.testing.assert_array_equal(back.walls, scope.walls)
    np.testing.assert_array_equal(back.movable(5), [False, True, False, True, False])
    assert Scope().empty
    assert Scope().movable(3).all()


def test_another_scope_has_another_name():
    names = {scope_file(scope)[0] for scope in (
        Scope(present()), Scope(present(), np.array([1])), Scope(present(), np.array([2])),
        Scope(walls=np.array([1, 2])), Scope(only=np.array([1, 2])),
    )}  # fmt: skip
    assert len(names) == 5


@pytest.mark.parametrize(
    ("scope", "words"),
    [
        (Scope(present(4)), r"present weights \(4, 2\)"),
        (Scope(present() * 2), "do not sum to 1"),
        (Scope(np.full((5, 2), np.nan, np.float32)), "do not sum to 1"),
        (Scope(np.zeros((5, 2), np.float32)), "no splat with weights to start from"),
        (Scope(present(), np.array([], np.int64)), "names no splats"),
        (Scope(present(), np.array([0.5])), "names no splats"),
        (Scope(present(), np.array([5])), "outside 0 to 4"),
        (Scope(present(), np.array([-1])), "outside 0 to 4"),
        (Scope(present(), np.array([1, 1])), "some twice"),
        (Scope(only=np.array([1])), "no weights for the rest"),
        (Scope(walls=np.array([1, 2])), r"walls \(2,\)"),
        (Scope(walls=np.ones(5)), "walls .* float64"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, scope, words):
    name = write_scope(tmp_path, scope)
    with pytest.raises(InputError, match=words):
        read_scope(tmp_path / name, 5, 2)


def test_splats_without_weights_start_from_their_neighbours_on_this_side(tmp_path):
    weights = present()
    weights[[1, 3]] = 0
    means = np.array([[0, 0, 0], [1, 0, 0], [1.5, 0, 0], [9, 0, 0], [8, 0, 0]], np.float32)
    scope = read_scope(tmp_path / write_scope(tmp_path, Scope(weights, np.array([1]))), 5, 2)
    np.testing.assert_array_equal(scope.present, weights)
    np.testing.assert_array_equal(scope.filled(means).present, weights[[0, 2, 2, 4, 4]])
    apart = Scope(weights, walls=np.array([1, 1, 2, 0, 0])).filled(means)
    np.testing.assert_array_equal(apart.present, weights[[0, 0, 2, 4, 4]])
    full = Scope(present())
    assert full.filled(means) is full


def test_files_that_hold_no_scope_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.npz' is missing"):
        read_scope(tmp_path / "none.npz", 5, 2)
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"bad\.npz' is damaged"):
        read_scope(tmp_path / "bad.npz", 5, 2)
