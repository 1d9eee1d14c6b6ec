# SPDX-License-Identifier: GPL-3.0-or-later

import json

import numpy as np
import pytest
from benchmark_bodies import capsule_asset, result

from benchmarks.quality.export import splats_digest, write_obj, write_task
from benchmarks.quality.methods import MethodInput, Unavailable, create_method, from_file
from benchmarks.quality.protocol import Protocol
from benchmarks.quality.results_file import read_results, results_document
from benchmarks.quality.submitted import digest_of, read_submitted
from gskin_addon.core.errors import InputError
from gskin_addon.core.files import read_arrays, write_json
from gskin_addon.core.rig.rignet_file import write_rignet
from gskin_addon.core.skeleton.joint_text import read_joint_text
from gskin_addon.core.splats.axes import up_rotation
from gskin_addon.core.splats.ply import read_ply

NAMES = np.array(["lower", "upper"])


@pytest.fixture(scope="module")
def asset():
    return capsule_asset(400)


def test_weights_come_from_either_kind_of_file_with_bones_in_any_order(asset, tmp_path):
    np.savez(tmp_path / "capsule.npz", weights=asset.weights[:, ::-1], bones=NAMES[::-1])
    assert np.allclose(read_submitted(tmp_path, asset).weights, asset.weights, atol=1e-6)
    (tmp_path / "capsule.npz").unlink()
    write_rignet(tmp_path / "capsule.txt", asset.weights, asset.skeleton)
    assert np.allclose(read_submitted(tmp_path, asset).weights, asset.weights, atol=1e-5)
    np.savez(tmp_path / "capsule.npz", weights=asset.weights, bones=NAMES)
    with pytest.raises(InputError, match="both"):
        read_submitted(tmp_path, asset)


def test_weights_of_a_mesh_reach_the_splats(asset, tmp_path):
    verts, faces = asset.surface.verts, asset.surface.faces
    upper = np.clip((verts[:, 0] - 0.8) / 0.4, 0, 1)
    np.savez(tmp_path / "capsule.npz", weights=np.stack([1 - upper, upper], 1), bones=NAMES)
    with pytest.raises(InputError, match=r"capsule\.obj beside it"):
        read_submitted(tmp_path, asset)
    write_obj(tmp_path / "capsule.obj", verts, faces)
    found = read_submitted(tmp_path, asset)
    assert found.on_mesh
    assert np.abs(found.weights - asset.weights).mean() < 0.02


@pytest.mark.parametrize(
    "change",
    [lambda v: (v - v.mean(axis=0)) / np.ptp(v), lambda v: 100 * v, lambda v: v + 5, lambda v: v[:, [2, 1, 0]]],
    ids=["in a unit cube", "in centimetres", "elsewhere", "other axes"],
)
def test_a_mesh_in_another_place_is_refused(asset, tmp_path, change):
    """Its nearest places would give every splat some weights, silently."""
    verts, faces = asset.surface.verts, asset.surface.faces
    upper = np.clip((verts[:, 0] - 0.8) / 0.4, 0, 1)
    np.savez(tmp_path / "capsule.npz", weights=np.stack([1 - upper, upper], 1), bones=NAMES)
    write_obj(tmp_path / "capsule.obj", change(verts), faces)
    with pytest.raises(InputError, match=r"capsule\.obj' does not lie where the splats are"):
        read_submitted(tmp_path, asset)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w: {"weights": w[:-1]}, "399 rows for 400 splats"),
        (lambda w: {"weights": w * 0.9}, "do not sum to 1"),
        (lambda w: {"weights": np.where(w > 0.5, np.nan, w)}, "not finite"),
        (lambda w: {"weights": w * [[2, -1]] + [[-1, 1]]}, "negative"),
        (lambda w: {"bones": np.array(["lower", "tail"])}, "'tail', which the skeleton lacks"),
        (lambda w: {"bones": np.array(["lower", "lower"])}, "twice"),
        (lambda w: {"bones": NAMES.astype(object)}, "cannot be read"),
        (lambda w: {"weights": (w > 0.5).astype(int)}, "write floats"),
        (lambda w: {"weights": w[:0]}, "do not sum to 1"),
    ],
)
def test_wrong_files_are_refused_in_a_sentence(asset, tmp_path, change, words):
    np.savez(tmp_path / "capsule.npz", **{"weights": asset.weights, "bones": NAMES, **change(asset.weights)})
    with pytest.raises(InputError, match=words):
        read_submitted(tmp_path, asset)


def test_a_folder_is_a_method(asset, tmp_path, monkeypatch):
    monkeypatch.setenv(from_file.VARIABLE, "{}")
    with pytest.raises(Unavailable, match="--method-weights theirs=FOLDER"):
        create_method("file:theirs")
    assert from_file.register([f"theirs={tmp_path}"]) == ["file:theirs"]
    method, subject = create_method("file:theirs"), MethodInput(asset, asset.skeleton, asset.weights)
    with pytest.raises(Unavailable, match=r"no capsule\.npz"):
        method.make(subject)
    np.savez(tmp_path / "capsule.npz", weights=asset.weights, bones=NAMES)
    made = method.make(subject)
    assert np.allclose(made.weights, asset.weights, atol=1e-6)
    known = result("capsule", "file:theirs", 1.0, note=made.note)
    assert not from_file.is_stale(known)
    np.savez(tmp_path / "capsule.npz", weights=np.full((400, 2), 0.5), bones=NAMES)
    assert from_file.is_stale(known)
    for pair in ("theirs", f"a b={tmp_path}", "theirs=/nowhere/at/all"):
        with pytest.raises(InputError):
            from_file.register([pair])


def test_a_method_is_given_splats_and_skeleton_and_no_weights(asset, tmp_path):
    write_task(tmp_path, asset, mesh=False)
    assert np.allclose(read_ply(tmp_path / "splats.ply").cloud.means, asset.cloud.means, atol=1e-6)
    given = read_arrays(tmp_path / "input.npz")
    assert set(given) == {"means", "quats", "scales", "opacities", "sh", "bones", "parents", "heads", "tails"}
    joints = read_joint_text(tmp_path / "skeleton.txt")
    assert joints.names == asset.skeleton.names
    assert np.allclose(joints.heads @ up_rotation("y").T, asset.skeleton.heads, atol=1e-6)


def test_results_are_a_file_of_a_known_version(asset, tmp_path):
    document = results_document(
        "theirs", Protocol(), [result("a", "file:theirs", 1.0), result("b", "file:theirs", 3.0)],
        {"c": "no file"}, {"a": splats_digest(asset), "b": "2"},
    )  # fmt: skip
    path = tmp_path / "results.json"
    write_json(path, document)
    read = read_results(path)
    assert read["mean"]["error"] == 2.0
    assert read["mean"]["lpips"] is None
    assert read["missing"] == {"c": "no file"}
    for change, words in (({"version": 9}, "version 9"), ({"schema": "x"}, "schema"), ({"assets": [{}]}, "no score")):
        path.write_text(json.dumps({**document, **change}))
        with pytest.raises(InputError, match=words):
            read_results(path)
    one = document["assets"][0]
    for change, words in (
        ({"version": True}, "version True"),
        ({"missing": []}, "table of what is missing"),
        ({"assets": [{**one, "asset": []}]}, "no score"),
        ({"assets": [one, one]}, "'a' comes twice"),
        ({"mean": {}}, "mean error is None"),
        ({"mean": None}, "no means"),
        ({"mean": {**document["mean"], "error": 1.0}}, "its mean error is 1.0, that of its assets 2.0"),
    ):
        path.write_text(json.dumps({**document, **change}))
        with pytest.raises(InputError, match=words):
            read_results(path)
    path.write_text("[" * 100_000)
    with pytest.raises(InputError, match="cannot be read"):
        read_results(path)
    document["assets"][0]["score"]["psnr"] = None
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="the psnr None"):
        read_results(path)


def test_no_digest_without_a_file(tmp_path):
    assert digest_of(tmp_path, "capsule") == ""
