# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.cleanup import (
    Cleanup,
    clamp_aspect,
    find_faint_giants,
    find_needles,
    find_strays,
    isotropic,
)
from gskin_addon.core.splats.cloud import SplatCloud
from tests.helpers.limb import make_limb

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).resolve().parents[4] / "shared" / "assets"))
BIKER = ASSETS / "splats" / "pc_biker.ply"


def merged(*clouds):
    """One cloud of several of degree 0."""
    return SplatCloud(
        *(np.concatenate([getattr(c, name) for c in clouds]) for name in ("means", "quats", "scales", "opacities")),
        np.concatenate([c.sh[:, :1] for c in clouds]),
    )


def at(points, scale=0.01, opacity=0.9):
    points = np.asarray(points, np.float32)
    count = len(points)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return SplatCloud(points, quats, np.full((count, 3), scale), np.full(count, opacity), np.zeros((count, 1, 3)))


@pytest.mark.parametrize("count", [300, 3000, 30_000])
@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_a_clean_body_has_no_strays(count, unit):
    limb = make_limb(count).cloud
    assert not find_strays(replace(limb, means=limb.means * np.float32(unit))).any()


def test_lone_splats_and_small_clusters_are_strays_and_parts_are_not():
    rng = np.random.default_rng(0)
    body = make_limb(5000).cloud
    lone = at([[1.5, 0, 1], [1e4, 0, 0], [0, -2, 0]])
    clump = at(rng.normal((1, 1, 0), 0.01, (20, 3)))
    hat = at(rng.normal((2.5, 0, 0.5), 0.03, (400, 3)))  # apart from the body, yet much of the object
    strays = find_strays(merged(body, lone, clump, hat))
    expected = np.repeat([False, True, False], [5000, 23, 400])
    assert (strays != expected)[:5023].sum() == 0
    assert strays[5023:].mean() < 0.02  # the outermost of a normal cloud stand alone


def test_few_splats_are_never_all_strays():
    assert not find_strays(at([[0, 0, 0], [1, 0, 0], [0, 5, 0]])).any()
    assert not find_strays(at([[0, 0, 0]])).any()
    assert find_strays(at(np.zeros((0, 3)))).shape == (0,)
    assert find_faint_giants(at(np.zeros((0, 3)))).shape == (0,)
    assert not find_strays(at(np.zeros((9, 3)))).any()  # all in one place


def test_faint_giants():
    limb = make_limb(500).cloud  # 3 long
    scales, opacities = limb.scales.copy(), limb.opacities.copy()
    scales[[3, 4], 1] = 0.5
    opacities[:] = 0.9
    opacities[[4, 5]] = 0.05
    found = find_faint_giants(replace(limb, scales=scales, opacities=opacities))
    assert np.flatnonzero(found).tolist() == [4]


def test_needles_are_widened_and_keep_their_area():
    scales = np.array([[1, 0.01, 0.1], [0.2, 0.3, 1e-5], [0.1, 4, 0.02], [0, 1, 0]], np.float32)
    cloud = replace(at(np.zeros((4, 3))), scales=scales)
    assert find_needles(cloud, 5).tolist() == [True, False, True, True]
    clamped, changed = clamp_aspect(cloud, 5)
    assert changed.tolist() == [True, False, True, True]
    ordered, before = np.sort(clamped.scales, axis=1), np.sort(scales, axis=1)
    np.testing.assert_allclose(ordered[[0, 2, 3], 2] / ordered[[0, 2, 3], 1], 5, rtol=1e-5)
    np.testing.assert_allclose(ordered[:3, 1:].prod(1), before[:3, 1:].prod(1), rtol=1e-5)
    np.testing.assert_array_equal(clamped.scales[1], scales[1])
    np.testing.assert_array_equal(clamped.scales[0].argsort(), scales[0].argsort())  # the axes keep their order
    assert not find_needles(clamped, 5).any()
    assert clamp_aspect(clamped, 5)[0] is clamped
    with pytest.raises(InputError, match="at least 1"):
        clamp_aspect(cloud, 0.5)


def test_balls_keep_the_area():
    limb = make_limb(50).cloud
    balls = isotropic(limb)
    np.testing.assert_array_equal(balls.scales, balls.scales[:, :1].repeat(3, 1))
    np.testing.assert_allclose(balls.scales[:, 0] ** 2, np.sort(limb.scales, 1)[:, 1:].prod(1), rtol=1e-5)
    np.testing.assert_array_equal(balls.quats, np.tile([1, 0, 0, 0], (50, 1)))
    np.testing.assert_array_equal(balls.means, limb.means)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"strays": True}, "no option strays"),
        ({"ignore_strays": 1}, "ignore_strays is 1"),
        ({"isotropic": "yes"}, "isotropic is 'yes'"),
        ({"max_aspect": 0.5}, "max_aspect is 0.5"),
        ({"max_aspect": True}, "max_aspect is True"),
    ],
)
def test_bad_options_are_named(values, words):
    with pytest.raises(InputError, match=words):
        Cleanup.parse(values)


def test_counts_of_a_job():
    body = make_limb(1000).cloud
    cloud = merged(body, at([[1, 0, 2]]), at([[1, 0, 0]], 0.4, 0.02))
    bad, counts = Cleanup.parse({}).find(cloud)
    assert counts == {"strays": 1, "faint_giants": 1}
    assert np.flatnonzero(bad).tolist() == [1000, 1001]
    assert not Cleanup(ignore_strays=False, ignore_faint_giants=False).find(cloud)[0].any()
    assert Cleanup().shape(cloud) == (cloud, {})
    shaped, needles = Cleanup(max_aspect=1.01, isotropic=True).shape(cloud)
    assert needles["needles"] == int(find_needles(cloud, 1.01).sum())
    assert np.ptp(shaped.scales, axis=1).max() == 0


@pytest.mark.skipif(not BIKER.is_file(), reason="the shared assets are not here")
def test_a_capture():
    from gskin_addon.core.splats.ply import read_ply

    cloud = read_ply(BIKER).cloud
    assert find_strays(cloud).mean() < 0.001
    assert 1 <= find_faint_giants(cloud).sum() < 100
    assert find_needles(cloud, 10).mean() == pytest.approx(0.2, abs=0.05)
