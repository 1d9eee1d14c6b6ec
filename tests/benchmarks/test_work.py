# SPDX-License-Identifier: GPL-3.0-or-later

import numpy as np
import pytest
from benchmark_bodies import capsule_asset
from PIL import Image

from benchmarks.quality import pictures, work
from benchmarks.quality.catalog import Entry
from benchmarks.quality.methods import Method
from benchmarks.quality.methods.base import MethodResult, Unavailable, rigid_weights
from benchmarks.quality.protocol import Protocol
from benchmarks.quality.results import FAILED, OK, load_weights, save_weights, weights_path
from benchmarks.quality.summary import Summary

SMALL = Protocol(splats=600, frames=3, picture_frames=1, views=2, size=64, poses=2)


@pytest.fixture
def capsule(monkeypatch):
    asset = capsule_asset(600)
    for module in (work, pictures):
        monkeypatch.setattr(module, "load_asset", lambda *_, **__: asset)
    monkeypatch.setattr(work, "entry_of", lambda name: Entry(name, "creature", "capsules"))
    return asset


def _broken(subject):
    raise RuntimeError("the solver gave up")


def _absent(subject):
    raise Unavailable("no such thing here")


METHODS = {
    "truth": Method(lambda subject: MethodResult(subject.truth)),
    "nearest": Method(lambda subject: MethodResult(rigid_weights(subject.cloud.means, subject.skeleton))),
    "broken": Method(_broken),
    "absent": Method(_absent),
}


def test_methods_are_made_judged_and_kept(capsule, tmp_path, monkeypatch):
    monkeypatch.setattr(work, "create_method", METHODS.__getitem__)
    task = work.Task("capsule", "own", ("truth", "nearest", "broken", "absent"), (("crashed", "it fell over"),))
    messages = list(work.perform(task, SMALL, tmp_path, None))
    found = {m[1].method: m[1] for m in messages if m[0] == "result"}
    assert ("unavailable", "absent", "no such thing here") in messages
    assert set(found) == {"truth", "nearest", "broken", "crashed"}
    assert (found["truth"].status, found["truth"].family) == (OK, "capsules")
    assert found["truth"].score["error"] < 1e-4 < found["nearest"].score["error"]
    # Failures are scored as if all followed the nearest bone.
    assert found["broken"].status == found["crashed"].status == FAILED
    assert found["crashed"].seconds is None
    assert found["broken"].score == found["crashed"].score == found["nearest"].score
    assert "RuntimeError: the solver gave up" in found["broken"].note
    kept = load_weights(weights_path(tmp_path, "capsule", "nearest", SMALL.key))
    assert np.array_equal(kept, rigid_weights(capsule.cloud.means, capsule.skeleton))
    assert not weights_path(tmp_path, "capsule", "broken", SMALL.key).exists()


def test_weights_on_a_disturbed_skeleton_are_judged_on_the_true_one(capsule, tmp_path, monkeypatch):
    monkeypatch.setattr(work, "create_method", METHODS.__getitem__)
    scores = {}
    for skeleton in ("own", "redundant", "moved"):
        messages = work.perform(work.Task("capsule", skeleton, ("nearest",)), SMALL, tmp_path, None)
        (result,) = [m[1] for m in messages if m[0] == "result"]
        scores[skeleton] = result.score
    assert scores["redundant"] == pytest.approx(scores["own"])  # halves of a bone move as one
    assert scores["moved"]["error"] > scores["own"]["error"]


def test_contact_sheets_show_the_cases_that_have_all_weights(capsule, tmp_path, monkeypatch):
    monkeypatch.setattr(work, "create_method", lambda name: METHODS["truth" if name == "ours:default" else "nearest"])
    monkeypatch.setattr(pictures, "TILE", 48)
    methods = ("initial", "heat_mesh", "ours:default")
    results = [
        m[1]
        for asset in ("a", "b", "c")
        for m in work.perform(work.Task(asset, "own", methods), SMALL, tmp_path, None)
        if m[0] == "result"
    ]
    weights_path(tmp_path, "c", "initial", SMALL.key).unlink()
    save_weights(weights_path(tmp_path, "b", "initial", SMALL.key), capsule.weights[:, ::-1])
    made = pictures.make_sheets(Summary(results, SMALL.key), SMALL, tmp_path, tmp_path / "images", "ours:default", 2)
    assert [name for name, _ in made] == ["quality_best.jpg", "quality_worst.jpg"]
    assert made[0][1].endswith("a, b")
    sheet = Image.open(tmp_path / "images" / "quality_best.jpg")
    assert sheet.size == (5 * 48, 2 * 48)
    assert (tmp_path / "images" / "quality_best.jpg").stat().st_size < pictures.MOST_BYTES
