# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from rigged_assets import write_collection, write_tube

from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.diffusion import DiffusionGuidance
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.training.guidance.make_pairs import PairScene, PairSettings, make_pairs
from gskin_addon.core.training.guidance.pairs import PairDataset, read_manifest
from gskin_addon.core.training.rigged import load_asset

SETTINGS = PairSettings(poses_per_view=3, size=64, splats=600, seed=2, validation=0.3, shard=5, true_masks=1.0)


def silent(done, message):
    return None


def files(folder):
    return {path.name: path.read_bytes() for path in (folder / "shards").iterdir()}


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    return write_collection(tmp_path_factory.mktemp("assets") / "set", {"fox": 2, "owl": 1})


@pytest.fixture(scope="module")
def whole(assets, tmp_path_factory):
    out = tmp_path_factory.mktemp("pairs") / "out"
    make_pairs(assets, out, SETTINGS, silent)
    return out


def test_pairs_are_what_a_guidance_model_is_asked_for(whole):
    train, validation = PairDataset(whole), PairDataset(whole, "validation")
    assert (len(train), len(validation), train.size) == (24, 12, 64)
    assert {pair.asset for pair in train} == {"fox_0", "fox_1"}
    assert {pair.asset for pair in validation} == {"owl_0"}
    assert sorted({pair.view for pair in train}) == [0, 1, 2, 3]
    for pair in train:
        assert pair.rest.shape == pair.posed.shape == (64, 64, 3)
        assert (pair.rest.dtype, pair.mask.dtype, pair.handles.dtype) == (np.uint8, bool, np.float32)
        assert pair.handles.shape == pair.targets.shape
        assert len(pair.handles) > 0
        differs = np.abs(pair.rest.astype(int) - pair.posed).max(-1)
        assert differs[pair.mask].max() > 5
        outside = differs[~pair.mask]
        assert (outside > 6).sum() <= 6 * 10  # specks below the mask's smallest region
        assert np.linalg.norm(pair.handles - pair.targets, axis=1).min() > 1


def test_pairs_hold_the_skeleton_that_the_points_belong_to(whole):
    for pair in PairDataset(whole):
        assert pair.bones.rest.shape == pair.bones.posed.shape == (len(pair.bones.bone), 2, 3)
        for points, bones in ((pair.handles, pair.bones.rest), (pair.targets, pair.bones.posed)):
            ends = bones[..., :2].reshape(-1, 2)
            assert np.linalg.norm(points[:, None] - ends, axis=-1).min(axis=1).max() < 1e-3


def test_points_are_where_the_joints_are(assets):
    scene = PairScene(load_asset(assets / "npz" / "fox_1.npz", 600), 64)
    pair = scene.pair(0, np.random.default_rng(0))
    skeleton = scene.asset.skeleton
    joints = np.concatenate([skeleton.heads, skeleton.tails])
    seen = scene.cameras[0].project(joints)[0]
    for point in pair.handles:
        assert np.linalg.norm(seen - point, axis=1).min() < 1e-3
    size = np.linalg.norm(np.ptp(scene.asset.cloud.means, axis=0))
    assert size == pytest.approx(1.0, abs=0.01)  # unit size, as Eq. 6 wants it


def test_a_pairs_mask_is_the_one_that_a_provider_is_given(assets):
    """With its holes; in a share of the pairs what truly changes belongs to it, too."""
    scene = PairScene(load_asset(assets / "npz" / "fox_1.npz", 600), 64)
    # Weights that are wrong enough for the mask to have holes.
    scene.initial = np.roll(scene.initial, 1, axis=1)
    context = GuidanceContext(scene.asset.cloud, scene.asset.skeleton, scene.initial, np.zeros_like(scene.initial))
    seen = []

    class Watching:
        batch = 1

        def paint(self, frames, tick):
            seen.extend(frame.mask for frame in frames)
            return [frame.rest for frame in frames]

    guidance = DiffusionGuidance(context, Watching, {})
    holes, number = 0, 0
    for view, camera in enumerate(scene.cameras):
        pair = scene.pair(view, np.random.default_rng(view), true_masks=0.0)
        (signal,) = make_signals(scene.asset.skeleton, [camera], 1, np.random.default_rng(view))
        if pair is None or not np.allclose(pair.handles, signal.handles):
            continue  # the first pose changed nothing
        list(guidance.images([replace(signal, view=view)]))
        np.testing.assert_array_equal(pair.mask, seen[-1])
        whole = scene.pair(view, np.random.default_rng(view), true_masks=1.0)
        np.testing.assert_array_equal(whole.posed, pair.posed)
        assert (whole.mask >= pair.mask).all()
        differs = np.abs(pair.rest.astype(int) - pair.posed).max(-1) > 6
        holes += (differs & ~pair.mask).sum() - (differs & ~whole.mask).sum()
        number += 1
    assert number > 1
    assert holes > 20


def test_a_share_of_the_pairs_has_true_masks(assets):
    scene = PairScene(load_asset(assets / "npz" / "fox_1.npz", 600), 64)
    scene.initial = np.roll(scene.initial, 1, axis=1)

    def masks(share):
        return [scene.pair(0, np.random.default_rng(k), share).mask for k in range(30)]

    none, half, every = masks(0.0), masks(0.5), masks(1.0)
    kinds = [
        (np.array_equal(mask, without), np.array_equal(mask, whole))
        for mask, without, whole in zip(half, none, every, strict=True)
    ]
    told = [kind for kind in kinds if kind != (True, True)]  # where the two differ
    assert set(told) == {(True, False), (False, True)}
    assert 0.2 < np.mean([whole for _, whole in told]) < 0.8


def test_a_scene_that_nothing_moves_gives_no_pair(assets, monkeypatch):
    scene = PairScene(load_asset(assets / "npz" / "fox_0.npz", 600), 64)
    scene.cameras = paper_views(np.full(3, 50.0), np.full(3, 51.0), 64)
    scene.rest = [np.ones((64, 64, 3), np.float32)] * 4
    assert scene.pair(0, np.random.default_rng(0)) is None


def test_the_same_seed_makes_the_same_files(assets, whole, tmp_path):
    make_pairs(assets, tmp_path / "again", SETTINGS, silent)
    assert files(tmp_path / "again") == files(whole)
    make_pairs(assets, tmp_path / "other", replace(SETTINGS, seed=3), silent)
    assert not set(files(tmp_path / "other").values()) & set(files(whole).values())


@pytest.mark.parametrize("stop_at", [0.2, 0.6])
def test_a_stopped_run_goes_on_and_makes_the_same(assets, whole, tmp_path, stop_at):
    out = tmp_path / "out"

    def stop(done, message):
        if done > stop_at:
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        make_pairs(assets, out, SETTINGS, stop)
    finished = files(out)
    assert 0 < len(finished) < len(files(whole))
    assert len(read_manifest(out)["shards"]) == len(finished)
    before = {path.name: path.stat().st_mtime_ns for path in (out / "shards").iterdir()}
    told = []
    make_pairs(assets, out, SETTINGS, lambda done, message: told.append(done))
    assert files(out) == files(whole)
    assert all((out / "shards" / name).stat().st_mtime_ns == time for name, time in before.items())
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_lost_shard_is_made_again(assets, whole, tmp_path):
    out = tmp_path / "out"
    make_pairs(assets, out, SETTINGS, silent)
    lost = sorted((out / "shards").iterdir())[1]
    lost.unlink()
    make_pairs(assets, out, SETTINGS, silent)
    assert files(out) == files(whole)


def test_another_folders_content_is_not_touched(assets, whole, tmp_path):
    with pytest.raises(InputError, match="other settings"):
        make_pairs(assets, whole, replace(SETTINGS, seed=9), silent)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        make_pairs(assets, tmp_path, SETTINGS, silent)


def test_an_asset_that_cannot_be_used_is_listed(tmp_path):
    (tmp_path / "assets").mkdir()
    write_tube(tmp_path / "assets" / "good.npz")
    write_tube(tmp_path / "assets" / "bad.npz", w_val=None)
    made = make_pairs(tmp_path / "assets", tmp_path / "out", replace(SETTINGS, validation=0), silent)
    assert list(made["failed"]) == ["bad"]
    assert {shard["asset"] for shard in made["shards"]} == {"good"}


def test_the_manifest_credits_the_authors(whole):
    manifest = json.loads((whole / "manifest.json").read_text())
    assert manifest["assets"][0] == {
        "name": "fox_0", "family": "fox", "split": "train", "licence": "CC0", "author": "A. Tester"
    }  # fmt: skip


def test_reading_what_is_no_data_set(whole, tmp_path):
    with pytest.raises(InputError, match="no set of image pairs"):
        PairDataset(tmp_path)
    with pytest.raises(InputError, match="no finished pairs to test"):
        PairDataset(whole, "test")
    (tmp_path / "manifest.json").write_text('{"version": 99}')
    with pytest.raises(InputError, match="version 99"):
        PairDataset(tmp_path)
    data = pickle.loads(pickle.dumps(PairDataset(whole)))  # as DataLoader's workers get it
    assert data[len(data) - 1].asset == "fox_1"
    with pytest.raises(IndexError):
        data[len(data)]


def test_a_damaged_shard_is_named(assets, tmp_path):
    out = tmp_path / "out"
    make_pairs(assets, out, SETTINGS, silent)
    shard = sorted((out / "shards").iterdir())[0]
    shard.write_bytes(shard.read_bytes()[:500])
    with pytest.raises(InputError, match=shard.name):
        PairDataset(out)[0]
