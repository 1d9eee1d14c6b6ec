# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line on Blender's data: rig, pose and render, from every kind of armature file, and what may go wrong."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import venv

import bpy
import numpy as np
import pretend
import pytest
import worker_jobs as jobs
from needs import WORKER, missing, only_with
from patience import HANG, interruptible
from pictures import read_picture

from gskin_addon import cli
from gskin_addon.core.errors import InputError
from gskin_addon.core.job.scope import read_scope
from gskin_addon.core.rig.quaternion import axis_angle_to_matrix
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.formats import read_splats, write_splats
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.core.worker.client import WorkerClient
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.seams import read_seams
from gskin_addon.scene.splat_object import is_splat_object, read_cloud
from gskin_addon.session import skin_job


def add_armature(name: str, bones=pretend.CHAIN, deform: bool = True):
    """An armature with a chain of bones, keyed to bend over ten frames, and a mesh that nobody asked for."""
    armature = pretend.add_armature(bones, name)
    for bone in armature.data.bones:
        bone.use_deform = deform
    if armature.pose.bones:
        bone = armature.pose.bones[-1]
        bone.rotation_mode = "QUATERNION"
        bone.keyframe_insert("rotation_quaternion", frame=1)
        bone.rotation_quaternion = (np.cos(0.5), np.sin(0.5), 0, 0)
        bone.keyframe_insert("rotation_quaternion", frame=10)
        armature.animation_data.action.name = f"{name} bend"
    cube = bpy.data.objects.new(f"{name} body", bpy.data.meshes.new("body"))
    cube.data.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    bpy.context.scene.collection.objects.link(cube)
    cube.parent = armature
    return armature


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A rod as .ply, and its rig as .blend, .glb and .fbx; rigs that cannot be used."""
    folder = tmp_path_factory.mktemp("inputs")
    write_ply(folder / "rod.ply", jobs.rod(300)[0])

    def save(name, *rigs, **how):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        for armature in rigs:
            add_armature(armature, **how)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / name), copy=True)

    save("none.blend")
    save("two.blend", "Rig", "Other")
    save("still.blend", "Rig", deform=False)
    save("far.blend", "Rig", bones=[("lower", (50, 0, 0), (50, 0, 1))])
    save("rig.blend", "Rig")
    bpy.ops.export_scene.gltf(filepath=str(folder / "rig.glb"))
    bpy.ops.export_scene.fbx(filepath=str(folder / "rig.fbx"), add_leaf_bones=False)
    (folder / "broken.glb").write_bytes(b"glTF but not really")
    (folder / "broken.blend").write_bytes(b"BLENDER but not really")
    # A header of a kind that no Blender of today knows.
    (folder / "newer.blend").write_bytes(b"BLENDER17-99v0999" + bytes(200))
    return folder


@pytest.fixture
def pretended(monkeypatch):
    """Jobs that give every splat to the first bone, at once."""
    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    monkeypatch.setattr(skin_job, "WorkerClient", functools.partial(WorkerClient, program=jobs.FAKE))
    return monkeypatch


@pytest.fixture(scope="module")
def rigged(files, tmp_path_factory):
    """A rod whose upper half follows the upper bone, as .blend and weights, and the process that made them.

    Where there is no torch the worker pretends: what Blender does with weights is the same in every version.
    """
    out = tmp_path_factory.mktemp("rigged") / "rod.blend"
    weights = out.with_name("w.npz")
    command = [sys.executable, "-m", "gskin_addon.cli", "rig", str(files / "rod.ply"), "--weights", str(weights)]
    command += ["--armature", str(files / "rig.blend"), "--out", str(out), "--preset", "draft", "--progress", "json"]
    command += ["--guidance", "elastic"]
    if missing(*WORKER):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("GSKIN_PYTHON", sys.executable)
            patch.setenv("GSKIN_TEST_ACT", "heights")
            patch.setattr(skin_job, "WorkerClient", functools.partial(WorkerClient, program=jobs.FAKE))
            assert run(*command[3:]) == 0
        return out, weights, None
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    return out, weights, done


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def test_rig_with_walls_keeps_them_by_the_rows_of_the_file(files, tmp_path, pretended):
    """Two splats of the file are invalid and dropped: the marks stay with the splats that had them."""
    cloud = read_ply(files / "rod.ply").cloud
    cloud.means[[0, 7], 0] = np.nan
    write_ply(tmp_path / "rod.ply", cloud)
    height = cloud.means[:, 2]
    marked = np.flatnonzero(height > 1)
    (tmp_path / "top.txt").write_text(" ".join(map(str, marked)))
    words = ("--drop-invalid", "--walls", tmp_path / "top.txt", "--job-dir", tmp_path / "job", "--progress", "none")
    rig = ("rig", tmp_path / "rod.ply", "--armature", files / "rig.blend", "--out", tmp_path / "o.blend", "--up", "z")
    assert run(*rig, *words) == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "o.blend"))
    obj = next(obj for obj in bpy.data.objects if is_splat_object(obj))
    labels = read_seams(obj)
    means = read_cloud(obj).means
    assert len(labels) == cloud.count - 2
    assert np.array_equal(labels, np.where(means[:, 2] > 1, 1, 2))
    (scope,) = (tmp_path / "job").glob("scope-*.npz")
    assert np.array_equal(read_scope(scope, len(labels), 2).walls, labels)
    assert "gskin walls" not in obj.data.attributes


def test_a_blend_can_be_painted_on_and_stays_so(files, tmp_path, pretended):
    """`rig` lays the fabric as Auto-Skin does; `weights` and `pose` keep what is there; none of it is for glTF."""
    rig = ("rig", files / "rod.ply", "--armature", files / "rig.blend", "--up", "z", "--progress", "none")
    outs = {name: tmp_path / f"{name}.blend" for name in ("rigged", "changed", "posed", "bare", "bare_changed")}
    assert run(*rig, "--out", outs["rigged"]) == 0
    assert run(*rig, "--out", outs["bare"], "--no-paintable") == 0
    assert run("weights", outs["rigged"], "--normalise", "--out", outs["changed"]) == 0
    assert run("weights", outs["bare"], "--normalise", "--out", outs["bare_changed"]) == 0
    assert run("pose", outs["rigged"], "--rotate", "lower", "20", "0", "0", "--out", outs["posed"]) == 0
    count = {}
    for name, path in outs.items():
        bpy.ops.wm.open_mainfile(filepath=str(path))
        (obj,) = (obj for obj in bpy.data.objects if is_splat_object(obj))
        count[name] = len(obj.data.polygons)
    assert count["rigged"] > 300
    assert count == {**dict.fromkeys(outs, count["rigged"]), "bare": 0, "bare_changed": 0}
    pretended.setattr(skin_job, "iter_fabric", None)  # would raise
    assert run(*rig, "--out", tmp_path / "rigged.glb") == 0


@only_with(*WORKER)
def test_rig_end_to_end(rigged, files):
    out, weights, done = rigged
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    events = [json.loads(line) for line in lines[:-1]]
    assert {"initial", "guidance", "optimise"} <= {event["stage"] for event in events}
    fractions = [event["fraction"] for event in events]
    assert fractions == sorted(fractions)
    assert lines[-1].startswith("300 splats follow 2 bones")

    found = read_weights_file(weights)
    assert found.bones == ("lower", "upper")
    np.testing.assert_allclose(found.heads, [[0, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1, atol=1e-5)
    height = read_ply(files / "rod.ply").cloud.means[:, 2]  # the PLY's order
    assert found.weights[height > 1.4, 1].mean() > 0.9
    assert found.weights[height < 0.6, 0].mean() > 0.9

    bpy.ops.wm.open_mainfile(filepath=str(out))
    (obj,) = (each for each in bpy.context.scene.objects if is_splat_object(each))
    assert {group.name for group in obj.vertex_groups} == {"lower", "upper"}
    assert armature_of(obj).name == "Rig"
    assert bpy.data.objects.get("Rig body") is None
    assert [action.name for action in bpy.data.actions] == ["Rig bend"]
    assert sorted(path.name for path in out.parent.iterdir()) == ["rod.blend", "w.npz"]


@pytest.mark.parametrize("name", ["rig.blend", "rig.glb", "rig.fbx"])
def test_armatures_of_every_kind(name, files, pretended, tmp_path):
    out = tmp_path / "out.glb"
    assert run("rig", files / "rod.ply", "--armature", files / name, "--out", out, "--weights", tmp_path / "w.npz") == 0
    found = read_weights_file(tmp_path / "w.npz")
    assert found.bones == ("lower", "upper")
    np.testing.assert_allclose(found.heads, [[0, 0, 0], [0, 0, 1]], atol=1e-4)
    np.testing.assert_allclose(found.tails[0], [0, 0, 1], atol=1e-4)
    head, _, rest = out.read_bytes().partition(b"JSON")
    assert head.startswith(b"glTF")
    content = json.loads(rest[: int.from_bytes(head[12:16], "little")])
    assert "KHR_gaussian_splatting" in content["extensionsUsed"]
    assert len(content["skins"]) == 1
    assert len(content["animations"]) == 1
    assert len(content["meshes"]) == 1


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--armature", "none.blend"], "no armature"),
        (["--armature", "nowhere.blend"], "does not exist"),
        (["--armature", "rod.ply"], ".fbx"),
        (["--armature", "broken.glb"], "broken.glb"),
        (["--armature", "broken.blend"], "broken.blend"),
        (["--armature", "newer.blend"], "as .glb or .fbx from the newer one"),
        (["--armature", "two.blend"], "--armature-name"),
        (["--armature", "two.blend", "--armature-name", "Third"], "'Other'"),
        (["--armature", "still.blend"], "Deform"),
        (["--armature", "far.blend"], "overlap|outside|axis"),
        (["--armature", "rig.blend", "--guidance", "oracle", "--guidance-option", "weights"], "NAME=VALUE"),
    ],
)
def test_bad_armatures_exit_2(arguments, word, files, pretended, tmp_path, capsys):
    out = tmp_path / "out.blend"
    arguments = [str(files / each) if "." in each else each for each in arguments]
    assert run("rig", files / "rod.ply", *arguments, "--out", out) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert any(each in text for each in word.split("|")), text
    assert not list(tmp_path.iterdir())


def test_one_of_several_armatures(files, pretended, tmp_path):
    out = tmp_path / "out.blend"
    assert (
        run("rig", files / "rod.ply", "--armature", files / "two.blend", "--armature-name", "Other", "--out", out) == 0
    )
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert [obj.name for obj in bpy.context.scene.objects if obj.type == "ARMATURE"] == ["Other"]


def test_the_input_is_never_overwritten(files, pretended, capsys):
    before = (files / "rig.blend").read_bytes()
    assert run("rig", files / "rod.ply", "--armature", files / "rig.blend", "--out", files / "rig.blend") == 2
    assert "overwrite" in capsys.readouterr().err
    assert (files / "rig.blend").read_bytes() == before


@only_with(*WORKER)
@pytest.mark.parametrize("agreed", [False, True])
def test_the_consent_to_download_goes_to_the_worker_alone(files, tmp_path, monkeypatch, agreed):
    heard = []

    class Client:
        def __init__(self, python, folder, *, allow_download, **_):
            heard.append((allow_download, "allow_download" in (folder / "job.json").read_text()))

        def start(self):
            raise InputError("No worker is started here.")

    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    monkeypatch.setattr(skin_job, "WorkerClient", Client)
    words = ["rig", files / "rod.ply", "--armature", files / "rig.blend", "--out", tmp_path / "out.blend"]
    words += ["--guidance", "flux_repair", "--guidance-option", "model=owner/name"]
    assert run(*words, *(["--allow-download"] if agreed else [])) == 2
    assert heard == [(agreed, False)]


def test_failing_jobs_exit_1_and_leave_nothing(files, pretended, tmp_path, capsys):
    pretended.setenv("GSKIN_TEST_ACT", "raise")
    arguments = ["rig", files / "rod.ply", "--armature", files / "rig.blend", "--out", tmp_path / "out.blend"]
    assert run(*arguments) == 1
    text = capsys.readouterr().err
    assert "Traceback" not in text
    assert run(*arguments, "--verbose") == 1
    assert "the middle of the matter" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_worker_without_torch_exits_2(files, monkeypatch, tmp_path, capsys):
    venv.create(tmp_path / "bare", symlinks=os.name == "posix")
    monkeypatch.setenv("GSKIN_PYTHON", str(tmp_path / "bare" / "bin" / "python"))
    out = tmp_path / "out.blend"
    assert run("rig", files / "rod.ply", "--armature", files / "rig.blend", "--out", out) == 2
    assert "install" in capsys.readouterr().err
    assert not out.exists()


@only_with(*WORKER)
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupting_exits_130_and_leaves_nothing(number, files, tmp_path):
    out, job = tmp_path / "out.blend", tmp_path / "job"
    command = [sys.executable, "-m", "gskin_addon.cli", "rig", str(files / "rod.ply"), "--preset", "thorough"]
    command += ["--armature", str(files / "rig.blend"), "--out", str(out), "--job-dir", str(job)]
    process = interruptible(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    process.stderr.readline()  # the worker runs
    process.send_signal(number)
    text = process.communicate(timeout=HANG)[1]
    assert process.returncode == 130
    assert text.splitlines()[-1].startswith("Cancelled")
    assert not out.exists()
    assert not (job / "weights.npz").exists()


def test_pose_turns_splats_about_the_bones_head(rigged, tmp_path):
    out, weights, _ = rigged
    posed = tmp_path / "posed.ply"
    assert run("pose", out, "--out", posed, "--rotate", "upper", "90", "0", "0") == 0
    before, after = jobs.rod(300)[0], read_ply(posed).cloud
    turn = axis_angle_to_matrix(np.array([1.0, 0, 0]), np.array(np.pi / 2))
    turned = (before.means - [0, 0, 1]) @ turn.T + [0, 0, 1]
    share = read_weights_file(weights).weights[:, 1:]
    np.testing.assert_allclose(after.means, share * turned + (1 - share) * before.means, atol=1e-4)


@only_with("PIL")  # reads .sog back without Blender
def test_pose_writes_every_format_of_splats(rigged, tmp_path):
    """In the format's own axes, read back as the .ply of the same pose."""
    turn = ["--rotate", "upper", "0", "90", "0"]
    out, _, _ = rigged
    assert run("pose", out, "--out", tmp_path / "a.ply", *turn) == 0
    wanted = read_ply(tmp_path / "a.ply").cloud
    for name in ("a.spz", "a.sog", "a.splat", "a.ksplat"):
        assert run("pose", out, "--out", tmp_path / name, *turn) == 0
        found = read_splats(tmp_path / name).cloud
        if found.up:
            found = rotate_cloud(found, up_rotation(found.up))
        np.testing.assert_allclose(found.means, wanted.means, atol=1e-3)
    assert run("pose", out, "--out", tmp_path / "a.obj") == 2


def test_rig_and_render_take_other_formats(files, tmp_path):
    """An .spz was turned to its own axes and comes back from them, so that the rig lies within the rod."""
    source, weights = tmp_path / "rod.spz", tmp_path / "w.npz"
    cloud = read_ply(files / "rod.ply").cloud
    write_splats(source, cloud)
    out = tmp_path / "out.blend"
    assert run("rig", source, "--armature", files / "rig.blend", "--out", out, "--weights", weights) == 0
    upper = read_weights_file(weights).weights[:, 1]
    height = cloud.means[:, 2]
    assert upper[height > 1.3].min() > 0.9
    assert upper[height < 0.7].max() < 0.1
    assert run("render", source, "--out", tmp_path / "rod.png", "--size", "64") == 0


def test_pose_by_frame_and_by_action(rigged, tmp_path, capsys):
    out, _, _ = rigged
    for name, options in (("first", ["--frame", "1"]), ("last", ["--frame", "10", "--action", "Rig bend"])):
        assert run("pose", out, "--out", tmp_path / f"{name}.ply", *options) == 0
    first, last = (read_ply(tmp_path / f"{name}.ply").cloud for name in ("first", "last"))
    np.testing.assert_allclose(first.means, jobs.rod(300)[0].means, atol=1e-5)
    assert np.abs(last.means - first.means).max() > 0.5
    capsys.readouterr()
    for options, word in ((["--action", "Jump"], "Rig bend"), (["--rotate", "tail", "1", "2", "3"], "'tail'")):
        assert run("pose", out, "--out", tmp_path / "x.ply", *options) == 2
        assert word in capsys.readouterr().err


def test_a_posed_blend_keeps_its_pose(rigged, tmp_path):
    out, _, _ = rigged
    assert run("pose", out, "--out", tmp_path / "posed.blend", "--rotate", "upper", "0", "40", "0") == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "posed.blend"))
    bpy.context.scene.frame_set(5)
    angle = bpy.data.objects["Rig"].pose.bones["upper"].rotation_quaternion.angle
    assert np.degrees(angle) == pytest.approx(40, abs=0.01)
    assert "Rig bend" in bpy.data.actions


@pytest.mark.parametrize(
    "extra",
    [
        [],
        ["--color", "weights"],
        ["--engine", "cycles"],
    ],
)
def test_render_of_a_pose(extra, rigged, tmp_path):
    out, _, _ = rigged
    shot = tmp_path / "shot.png"
    options = ["--view", "right", "--size", "64", "--rotate", "upper", "80", "0", "0", *extra]
    assert run("render", out, "--out", shot, *options) == 0
    ink = read_picture(shot).min(axis=2) < 235
    rows, columns = ink.nonzero()
    assert ink.mean() > 0.02
    assert np.ptp(columns) > 0.6 * np.ptp(rows)  # a rod that stands would be thin
    assert [path.name for path in tmp_path.iterdir()] == ["shot.png"]


def test_a_blend_without_splats_exits_2(files, tmp_path, capsys):
    assert run("render", files / "rig.blend", "--out", tmp_path / "x.png") == 2
    assert "no splat object" in capsys.readouterr().err
    assert run("pose", files / "broken.blend", "--out", tmp_path / "x.ply") == 2
