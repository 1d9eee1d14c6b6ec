# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import worker_jobs as jobs
from hypothesis import given, settings
from hypothesis import strategies as st

from gskin_addon.core import files
from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.job import contract
from gskin_addon.core.job.checks import check_inputs, overlap
from gskin_addon.core.rig.influences import Influences
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.rig.weights_file import read_weights_file, write_weights_file
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import read_ply

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).resolve().parents[4] / "shared" / "assets"))


def test_job_reads_back_exactly(tmp_path):
    cloud, skeleton = jobs.rod()
    contract.write_job(tmp_path / "deep" / "job", cloud, skeleton, {"preset": "draft", "seed": 3})
    job = contract.read_job(tmp_path / "deep" / "job")
    assert job.settings == {"preset": "draft", "seed": 3}
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(job.cloud, name), getattr(cloud, name))
    assert job.skeleton.names == skeleton.names
    np.testing.assert_array_equal(job.skeleton.rest, skeleton.rest)
    assert json.loads((job.folder / "job.json").read_text())["version"] == 1
    assert not list(job.folder.glob(".*")), "temporary files are left"


@given(rows=st.integers(2, 30), bones=st.integers(1, 6), seed=st.integers(0, 2**16))
@settings(max_examples=20, deadline=None)
def test_weights_read_back(tmp_path_factory, rows, bones, seed):
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(bones), rows).astype(np.float32)
    heads = rng.normal(size=(bones, 3))
    rig = Skeleton(tuple(f"kneé.{i}" for i in range(bones)), np.arange(bones) - 1, heads, heads + 1)
    path = tmp_path_factory.mktemp("w") / "weights.npz"
    write_weights_file(path, weights, rig)
    back = read_weights_file(path)
    np.testing.assert_array_equal(back.weights, weights)
    assert back.bones == rig.names
    np.testing.assert_array_equal(back.heads, rig.heads)
    np.testing.assert_array_equal(back.tails, rig.tails)
    np.testing.assert_array_equal(back.parents, rig.parents)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda w: w * 2, "sum to 1"),
        (lambda w: w[:, :1], "for 2 bones"),
        (lambda w: w * np.nan, "finite"),
        (lambda w: w + np.array([[1, -1]]) * 2, "negative"),
    ],
)
def test_bad_weights_are_not_written(tmp_path, spoil, words):
    _, skeleton = jobs.rod()
    with pytest.raises(ValueError, match=words):
        write_weights_file(tmp_path / "w.npz", spoil(np.full((5, 2), 0.5)), skeleton)
    assert not list(tmp_path.iterdir())


def test_confidence_reads_back_and_is_checked(tmp_path):
    rig = Skeleton(("a",), np.array([-1]), np.zeros((1, 3)), np.ones((1, 3)))
    weights, confidence = np.ones((4, 1), np.float32), np.linspace(0, 1, 4, dtype=np.float32)
    write_weights_file(tmp_path / "w.npz", weights, rig, confidence=confidence)
    np.testing.assert_array_equal(read_weights_file(tmp_path / "w.npz").confidence, confidence)
    for bad in (confidence[:3], confidence + 0.5, np.full(4, np.nan, np.float32)):
        with pytest.raises(ValueError, match=r"for 4 splats|outside 0\.\.1"):
            write_weights_file(tmp_path / "w.npz", weights, rig, confidence=bad)
    arrays = dict(np.load(tmp_path / "w.npz"))
    np.savez(tmp_path / "w.npz", **{**arrays, "confidence": confidence * 2})
    with pytest.raises(InputError, match="damaged confidence"):
        read_weights_file(tmp_path / "w.npz")


def test_the_start_reads_back_and_is_checked(tmp_path):
    _, skeleton = jobs.rod()
    weights = np.full((3, 2), 0.5, np.float32)
    start = Influences(np.array([[0, 1], [1, 0], [1, 1]], np.int32), np.array([[1, 0]] * 3, np.float32))
    path = tmp_path / "w.npz"
    write_weights_file(path, weights, skeleton, start=start)
    found = read_weights_file(path).start
    np.testing.assert_array_equal(found.index, start.index)
    np.testing.assert_array_equal(found.value, start.value)
    with pytest.raises(ValueError, match="for 3 splats"):
        write_weights_file(path, weights, skeleton, start=start.rows(np.array([0, 1])))
    arrays = dict(np.load(path))
    for bad in ({"start_bones": start.index + 9}, {"start_weights": start.value * 3}, {"start_weights": weights[:2]}):
        np.savez(path, **{**arrays, **bad})
        with pytest.raises(InputError, match="damaged weights to start from"):
            read_weights_file(path)


def test_bad_weights_are_not_read(tmp_path):
    arrays = {"bones": np.array(["a"]), "heads": np.zeros((1, 3)), "tails": np.ones((1, 3)), "parents": [-1]}
    np.savez(tmp_path / "w.npz", weights=np.full((3, 1), 0.5, np.float32), **arrays)
    with pytest.raises(InputError, match=r"w\.npz.*sum to 1"):
        read_weights_file(tmp_path / "w.npz")
    np.savez(tmp_path / "w.npz", **arrays)
    with pytest.raises(InputError, match="lacks the array weights"):
        read_weights_file(tmp_path / "w.npz")


@pytest.mark.parametrize("name", ["job.json", "splats.npz", "skeleton.json"])
def test_missing_and_damaged_files_are_named(tmp_path, name):
    folder = jobs.make_job(tmp_path / "job")
    whole = (folder / name).read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"\xff\x00 rubbish"):
        (folder / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            contract.read_job(folder)
    (folder / name).unlink()
    with pytest.raises(InputError, match=f"{name}' is missing"):
        contract.read_job(folder)


def test_pickled_objects_are_refused(tmp_path):
    folder = jobs.make_job(tmp_path)
    np.savez(folder / "splats.npz", means=np.array([{}], dtype=object))
    with pytest.raises(InputError, match=r"splats\.npz"):
        contract.read_job(folder)


def test_another_version_is_refused(tmp_path):
    folder = jobs.make_job(tmp_path)
    (folder / "job.json").write_text('{"version": 99}')
    with pytest.raises(InputError, match="version 99"):
        contract.read_job(folder)


def test_settings_must_be_plain(tmp_path):
    cloud, skeleton = jobs.rod()
    for value in (float("nan"), object()):
        with pytest.raises(InputError, match="settings"):
            contract.write_job(tmp_path / "job", cloud, skeleton, {"x": value})


def test_result_reads_back_with_its_pictures(tmp_path):
    job = contract.read_job(jobs.make_job(tmp_path))
    with pytest.raises(InputError, match="not finished"):
        contract.read_result(tmp_path)
    weights = np.tile(np.array([[0.25, 0.75]], np.float32), (job.cloud.count, 1))
    picture = np.random.default_rng(0).uniform(-0.1, 1.1, (7, 5, 3))
    report = {"loss": np.float64(0.5), "bad": np.nan, "curve": np.arange(3)}
    contract.write_result(job, weights, report, {"rest pose/1": picture})
    result = contract.read_result(tmp_path)
    np.testing.assert_array_equal(result.weights, weights)
    assert result.report == {"loss": 0.5, "bad": None, "curve": [0, 1, 2]}
    image = pytest.importorskip("PIL.Image").open(result.previews["rest_pose_1"])
    np.testing.assert_array_equal(np.asarray(image), np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8))


def test_same_job_keeps_its_checkpoint_and_another_one_starts_clean(tmp_path):
    folder = jobs.make_job(tmp_path, seed=0)
    (folder / "checkpoint").mkdir()
    (folder / "checkpoint" / "state").write_text("x")
    jobs.make_job(folder, seed=0)
    assert (folder / "checkpoint" / "state").exists()
    jobs.make_job(folder, seed=1)
    assert not (folder / "checkpoint").exists()


def test_a_folder_that_is_no_job_keeps_its_files(tmp_path):
    (tmp_path / "previews").mkdir()
    (tmp_path / "previews" / "mine.png").write_text("x")
    jobs.make_job(tmp_path)
    assert (tmp_path / "previews" / "mine.png").exists()


def test_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "w.npz"
    files.write_arrays(path, {"a": np.arange(3)})

    def full(*_args, **_kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(GSkinError, match=r"disk is full.*w\.npz") as caught:
        files.write_arrays(path, {"a": np.arange(5)})
    assert caught.value.exit_code == 1
    assert [p.name for p in tmp_path.iterdir()] == ["w.npz"]
    np.testing.assert_array_equal(np.load(path)["a"], np.arange(3))


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
@pytest.mark.parametrize("limit", [10, 3_000, 20_000])
def test_full_disk_for_real(tmp_path, limit):
    # The limit on file sizes stops a write in its middle, as a full disk does; it binds one whole process.
    code = (
        "import resource, sys, pathlib, numpy as np\n"
        "from gskin_addon.core import files\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
        "try: files.write_arrays(pathlib.Path(sys.argv[1]), {'a': np.ones(500), 'b': np.ones(5000)})\n"
        "except files.GSkinError as error: print(error)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "w.npz")], capture_output=True, text=True
    )
    assert "disk is full" in run.stdout, run.stderr
    assert not list(tmp_path.iterdir())


def test_too_few_and_too_many_splats():
    cloud, skeleton = jobs.rod(2)
    check_inputs(cloud, skeleton)
    for count in (0, 1):
        with pytest.raises(InputError, match=f"'Bear' has {count} splat"):
            check_inputs(cloud.select(slice(0, count)), skeleton, splats="'Bear'")

    count = 5_000_001
    empty = np.zeros((1, 3), np.float32)
    many = SplatCloud(
        *(
            np.broadcast_to(empty[..., :1] if n == 1 else np.zeros((1, n), np.float32), (count, n))
            for n in (3, 4, 3)
        ),
        opacities=np.broadcast_to(np.float32(1), (count,)),
        sh=np.broadcast_to(np.float32(0), (count, 1, 3)),
    )
    with pytest.raises(InputError, match=r"5,000,001 splats.*crop"):
        check_inputs(many, skeleton)


def test_bones_that_cannot_carry_weights():
    cloud, skeleton = jobs.rod()
    with pytest.raises(InputError, match="'Rig' has no deform bones"):
        check_inputs(cloud, skeleton.subset([False, False]), armature="'Rig'")
    flat = Skeleton(skeleton.names, skeleton.parents, skeleton.heads, skeleton.heads)
    with pytest.raises(InputError, match="'lower' of 'Rig' has zero length"):
        check_inputs(cloud, flat, armature="'Rig'")


def test_wrong_axis_is_told_with_the_right_one():
    cloud, skeleton = jobs.rod()
    for truth in ("y", "-y"):
        in_file = rotate_cloud(cloud, up_rotation(truth).T)
        with pytest.raises(InputError, match=f"does not overlap.*--ply-up={truth}"):
            check_inputs(in_file, skeleton)
        check_inputs(rotate_cloud(in_file, up_rotation(truth)), skeleton, up=truth)


def test_armature_elsewhere_is_refused():
    cloud, skeleton = jobs.rod()
    with pytest.raises(InputError, match=r"'Rig' does not overlap 'Bear'.*move or scale"):
        check_inputs(cloud, skeleton.moved(np.eye(3), 1.0, (50, 0, 0)), splats="'Bear'", armature="'Rig'")
    assert overlap(cloud.means, skeleton) == 1.0


@pytest.mark.skipif(not (ASSETS / "splats" / "pc_biker.ply").is_file(), reason="no shared assets here")
def test_real_capture_with_its_axis():
    root = ASSETS
    bones = json.loads((root / "splats" / "pc_biker_rig.json").read_text())["bones"]
    ends = [
        np.array([bone[end] for bone in bones.values()]) @ up_rotation("-y").T for end in ("head", "tail")
    ]
    rig = Skeleton(tuple(bones), np.full(len(bones), -1), *ends)
    cloud = read_ply(root / "splats" / "pc_biker.ply").cloud
    with pytest.raises(InputError, match="--ply-up=-y"):
        check_inputs(cloud, rig)
    check_inputs(rotate_cloud(cloud, up_rotation("-y")), rig, up="-y")
