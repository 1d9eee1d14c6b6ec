# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigs of another unit are recognised, sound ones and those in large captures are left alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.rig.rig_scale import guess_scale
from gskin_addon.core.rig.skeleton import Skeleton

HEADS = np.array([[0, 0, 0], [0, 0, 0.95], [0.1, 0, 1], [0.45, 0, 1], [-0.1, 0, 1], [-0.45, 0, 1]])
TAILS = np.array([[0, 0, 0.95], [0, 0, 1.3], [0.45, 0, 1], [0.8, 0, 1], [-0.45, 0, 1], [-0.8, 0, 1]])
RIG = Skeleton(("spine", "head", "arm.L", "hand.L", "arm.R", "hand.R"), np.array([-1, 0, 0, 2, 0, 4]), HEADS, TAILS)


def figure(count: int = 900) -> np.ndarray:
    """Points on the skin of tubes around the bones."""
    rng = np.random.default_rng(0)
    bone, along, turn = rng.integers(0, 6, count), rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count)
    axis = (TAILS - HEADS)[bone]
    upright = axis[:, 2] > 0
    radius = np.where(upright, 0.14, 0.06)
    ring = np.stack([np.cos(turn) * radius, np.sin(turn) * radius], axis=1)
    around = np.where(upright[:, None], np.c_[ring, np.zeros(count)], np.c_[np.zeros(count), ring])
    return HEADS[bone] + along[:, None] * axis + around


@pytest.mark.parametrize("factor", [0.001, 0.01, 0.0254, 0.1, 10, 1 / 0.0254, 100, 1000])
@pytest.mark.parametrize("place", [(0, 0, 0), (3.0, -2.0, 0.5)])
def test_units_are_recognised(factor, place):
    points = figure() + place
    about_origin = guess_scale(points, RIG.moved(np.eye(3), factor, place), np.array(place))
    assert about_origin.factor == pytest.approx(1 / factor)
    assert about_origin.sure
    assert f"{max(factor, 1 / factor):.3g} times too {'small' if factor < 1 else 'large'}" == about_origin.words
    moved = RIG.moved(np.eye(3), 1.0, place).moved(np.eye(3), factor)
    about_world = guess_scale(points, moved, factor * np.array(place))
    assert about_world.factor == pytest.approx(1 / factor)
    assert about_world.about_world == any(place)


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_a_sound_rig_is_left_alone(factor):
    assert guess_scale(figure(), RIG.moved(np.eye(3), factor), np.zeros(3)).words == ""


def test_a_rig_without_its_tail_or_with_invented_tails_is_left_alone():
    long = Skeleton(RIG.names, RIG.parents, HEADS, HEADS + 100 * (TAILS - HEADS))
    assert guess_scale(figure(), long, np.zeros(3)).factor == 1.0
    assert guess_scale(figure(), RIG.subset([0, 1]), np.zeros(3)).factor == 1.0


def test_a_large_capture_is_never_said_to_be_too_small():
    rng = np.random.default_rng(1)
    floor = np.c_[rng.normal(0, 6, (3000, 2)), rng.normal(0, 0.01, 3000)]
    guess = guess_scale(np.concatenate([figure(), floor]), RIG, np.zeros(3))
    assert guess.factor >= 1.0  # at most a word that the rig is small


def test_nothing_of_a_size():
    point = Skeleton(("a",), np.array([-1]), np.zeros((1, 3)), np.zeros((1, 3)))
    assert guess_scale(np.zeros((5, 3)), RIG, np.zeros(3)).factor == 1.0
    assert guess_scale(figure(), point, np.zeros(3)).factor == 1.0


@pytest.mark.skipif(not clouds.ASSETS.is_dir(), reason="no shared assets")
def test_rigged_assets():
    """Every 16th asset: none is doubted at its own size, and most other units are named; `benchmarks/rig_scale.py`."""
    from gskin_addon.core.training.rigged import load_asset

    entries = json.loads((clouds.ASSETS / "catalog.json").read_text())["assets"][::16]
    found = []
    for entry in entries:
        asset = load_asset(clouds.ASSETS / entry["npz"], 3000)
        assert guess_scale(asset.cloud.means, asset.skeleton, np.zeros(3)).factor == 1.0, entry["name"]
        for factor in (0.1, 100):
            guess = guess_scale(asset.cloud.means, asset.skeleton.moved(np.eye(3), factor), np.zeros(3))
            found.append(abs(np.log(guess.factor * factor)) < 1e-3)
    assert np.mean(found) > 0.85
