# SPDX-License-Identifier: GPL-3.0-or-later

import numpy as np
import pytest
from benchmark_bodies import capsule_asset

from benchmarks.quality.judge import MOST_PSNR, Judge, compare
from benchmarks.quality.lpips import Perceptual
from benchmarks.quality.perturb import DISTURBANCES, missing_limb, moved_joints, redundant_joints
from benchmarks.quality.protocol import Protocol
from gskin_addon.core.render.image_metrics import psnr, ssim
from gskin_addon.core.rig.lbs import skin_points

SMALL = Protocol(frames=4, picture_frames=2, views=2, size=96, poses=4)


@pytest.fixture(scope="module")
def asset():
    return capsule_asset(800)


def test_true_weights_have_no_error_and_worse_ones_have_more(asset):
    judge = Judge(asset, SMALL)
    right = judge.score(asset.weights)
    assert right.error < 1e-4
    assert right.psnr == MOST_PSNR
    assert right.ssim == pytest.approx(1.0)
    assert right.l1 == 0
    assert right.lpips is None
    half = 0.5 * asset.weights + 0.25
    wrong = judge.score(half)
    worse = judge.score(asset.weights[:, ::-1])
    assert 0 < wrong.error < worse.error
    assert wrong.error < wrong.error95
    assert worse.psnr < wrong.psnr < MOST_PSNR
    assert worse.random_error > wrong.random_error > 0
    with pytest.raises(ValueError, match="do not fit"):
        judge.score(asset.weights[:, :1])


def test_errors_are_those_of_the_animation_wherever_it_goes(asset):
    """A slow copy of the formula; and a walk across the room changes nothing."""
    from dataclasses import replace

    half = 0.5 * asset.weights + 0.25
    away = asset.clip.copy()
    away[:, :, :3, 3] += np.linspace(0, 50, len(away))[:, None, None]
    scores = [Judge(replace(asset, clip=clip), SMALL).score(half) for clip in (asset.clip, away)]
    points = asset.cloud.means.astype(float)
    lower, upper = asset.cloud.bounds()
    kept = asset.clip[[0, 1, 3, 4]]
    gap = skin_points(points, half, kept) - skin_points(points, asset.weights, kept)
    distance = np.linalg.norm(gap, axis=-1) / np.linalg.norm(upper - lower) * 100
    assert scores[0].error == pytest.approx(distance.mean(), rel=1e-4)
    assert scores[0].error95 == pytest.approx(np.percentile(distance, 95), rel=1e-4)
    assert scores[1].error == pytest.approx(scores[0].error, rel=1e-4)
    assert scores[1].psnr == pytest.approx(scores[0].psnr, abs=0.01)


def test_pictures_are_compared_as_the_plain_formulas_do():
    rng = np.random.default_rng(3)
    truth = np.ones((64, 80, 3), np.float32)
    truth[20:40, 30:50] = rng.random((20, 20, 3))
    image = truth.copy()
    image[25:35, 28:44] = rng.random((10, 16, 3))
    found = compare(image, truth)
    assert found[0] == pytest.approx(psnr(image, truth), abs=1e-4)
    assert found[1] == pytest.approx(ssim(image, truth), abs=1e-4)


def test_lpips_comes_from_a_file(tmp_path):
    torch = pytest.importorskip("torch")

    class Distance(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().mean()

    torch.jit.script(Distance()).save(str(tmp_path / "net.pt"))
    network = Perceptual(tmp_path / "net.pt")
    black, white = np.zeros((8, 9, 3), np.float32), np.ones((8, 9, 3), np.float32)
    assert network(black, white) == pytest.approx(2.0)
    assert network(white, white) == 0


@pytest.mark.parametrize("name", list(DISTURBANCES))
def test_disturbed_skeletons_keep_the_sums_of_weights(asset, name):
    case = DISTURBANCES[name](asset)
    case.skeleton.validate()
    assert case.fold.shape == (case.skeleton.count, case.asset.skeleton.count)
    assert (case.fold.sum(axis=1) == 1).all()
    assert np.allclose(case.asset.weights.sum(axis=1), 1, atol=1e-5)
    assert case.asset.clip.shape[1] == case.asset.skeleton.count
    if case.truth is not None:
        assert np.allclose(case.truth @ case.fold, case.asset.weights)


def test_what_is_disturbed(asset):
    more = redundant_joints(asset)
    assert more.skeleton.count == 4
    assert np.allclose(more.skeleton.tails[0], more.skeleton.heads[1])
    assert more.skeleton.parents.tolist() == [-1, 0, 1, 2]
    assert more.fold.argmax(axis=1).tolist() == [0, 0, 1, 1]

    lower, upper = asset.cloud.bounds()
    moved = moved_joints(asset).skeleton
    step = np.linalg.norm(moved.heads - asset.skeleton.heads, axis=1) / np.linalg.norm(upper - lower)
    assert np.allclose(step, 0.05)
    assert np.allclose(moved.tails[0], moved.heads[1])

    less = missing_limb(asset)
    assert less.skeleton.names == ("lower",)
    assert np.allclose(less.asset.weights, 1)
