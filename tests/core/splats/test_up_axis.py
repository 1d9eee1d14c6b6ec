# SPDX-License-Identifier: GPL-3.0-or-later
"""Guessing the up axis: right on captures and most figures, silent where nothing tells."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import InputError
from gskin_addon.core.job.up_axis import resolve_up
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.axes import UP_AXES, rotate_cloud, up_rotation
from gskin_addon.core.splats.ply import read_ply
from gskin_addon.core.splats.up_axis import guess_up
from gskin_addon.core.training.rigged import load_asset

needs_assets = pytest.mark.skipif(not (clouds.ASSETS / "catalog.json").is_file(), reason="no assets")


def test_a_ball_is_not_guessed():
    guess = guess_up(clouds.random_cloud(3000, 0))
    assert not guess.sure
    assert guess.axis == "z"
    assert "not sure" in guess.sentence


@pytest.mark.parametrize("count", [1, 50])
def test_few_splats_are_not_guessed(count):
    assert not guess_up(clouds.random_cloud(count, 0)).sure


def test_a_flat_cloud_is_not_guessed():
    cloud = clouds.random_cloud(500, 0)
    cloud.means[:, 1] = 0
    assert not guess_up(cloud).sure


@needs_assets
@pytest.mark.parametrize("name", ["pc_biker.ply", "pc_biker.compressed.ply", "pc_statue_angel.ply"])
def test_captures(name):
    guess = guess_up(read_ply(clouds.ASSETS / "splats" / name, drop_invalid=True).cloud)
    assert guess.axis == "-y"
    assert guess.sure
    assert "+Y end" in guess.reason


@needs_assets
def test_humanoids_are_seldom_guessed_wrong():
    """Every seventh humanoid of the catalogue, turned to every up axis; `benchmarks/up_axis.py` takes all."""
    entries = json.loads((clouds.ASSETS / "catalog.json").read_text())["assets"]
    outcomes = []
    for entry in [entry for entry in entries if entry["category"] == "humanoid"][::7]:
        cloud = load_asset(clouds.ASSETS / entry["npz"], 5000).cloud
        for up in UP_AXES:
            guess = guess_up(rotate_cloud(cloud, up_rotation(up).T))
            outcomes.append("not sure" if not guess.sure else "right" if guess.axis == up else "wrong")
    assert outcomes.count("right") >= 0.5 * len(outcomes)
    assert outcomes.count("wrong") <= 0.06 * len(outcomes)


def scene_of(*parts):
    """A Z-up cloud of points (N, 3)."""
    points = np.concatenate(parts)
    return dataclasses.replace(clouds.random_cloud(len(points), 0), means=points.astype(np.float32))


def sheet(rng, count, side, axis, place, middle=(0, 0, 1)):
    """Points of a plane of this side length, a little rough."""
    points = rng.uniform(-side / 2, side / 2, (count, 3)) + middle
    points[:, axis] = place + rng.normal(0, 0.004, count)
    return points


def body(rng):
    return rng.normal(0, 0.2, (1500, 3)) + [0.1, 0, 0.7]


@pytest.mark.parametrize("up", UP_AXES)
def test_what_stands_on_a_floor_is_told(up):
    rng = np.random.default_rng(0)
    strays = rng.uniform(-1, 1, (40, 3)) + [0, 0, -0.5]
    guess = guess_up(rotate_cloud(scene_of(body(rng), sheet(rng, 1000, 3, 2, 0), strays), up_rotation(up).T))
    assert guess.sure
    assert guess.axis == up
    assert "a floor lies at its" in guess.sentence


@pytest.mark.parametrize("up", UP_AXES)
@pytest.mark.parametrize("what", ["corner", "table", "backed"])
def test_other_planes_are_no_floors(what, up):
    """A room has walls, a table's top has its legs at the rim, and a slab nothing on it."""
    rng = np.random.default_rng(1)
    if what == "corner":
        cloud = scene_of(body(rng), sheet(rng, 1000, 3, 2, 0), sheet(rng, 600, 3, 1, 1.5, (0, 0, 1.5)))
    elif what == "table":
        legs = [rng.normal(0, 0.02, (300, 3)) * [1, 1, 15] + [x, y, 0.4] for x in (-0.9, 0.9) for y in (-0.9, 0.9)]
        cloud = scene_of(sheet(rng, 1500, 2, 2, 0.9), *legs)
    else:
        cloud = scene_of(sheet(rng, 2000, 2, 2, 0), sheet(rng, 2000, 2, 2, 0.3))
    assert not guess_up(rotate_cloud(cloud, up_rotation(up).T)).sure


def test_the_armature_tells_where_the_splats_do_not():
    rng = np.random.default_rng(0)
    cloud = clouds.random_cloud(2000, 0)
    cloud.means[:] = rng.normal(0, 0.1, (2000, 3)) + [0, -3, 1]  # -y up: around (0, 1, 3)
    heads = np.array([[0.0, 1.0, 2.9], [0.0, 1.0, 3.0]])
    tails = heads + [0, 0, 0.1]
    rest = np.tile(np.eye(4), (2, 1, 1))
    rest[:, :3, 3] = heads
    skeleton = Skeleton(names=("a", "b"), parents=np.array([-1, 0]), heads=heads, tails=tails, rest=rest)
    assert resolve_up("auto", cloud)[0] == "z"
    axis, sentence = resolve_up("auto", cloud, skeleton)
    assert axis == "-y"
    assert "armature" in sentence
    assert resolve_up("y", cloud, skeleton) == ("y", "")
    with pytest.raises(InputError, match="no up axis"):
        resolve_up("x", cloud)
