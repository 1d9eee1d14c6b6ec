# SPDX-License-Identifier: GPL-3.0-or-later
"""The click: what it asks for, what it does to the scene, and what it never does."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import venv
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pretend
import pytest
import worker_jobs as jobs
from mathutils import Matrix
from needs import WORKER, only_with
from patience import wait_until
from pretend import add_armature

import gskin_addon
from gskin_addon.core import files
from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.job.contract import read_job
from gskin_addon.core.job.lock import job_lock
from gskin_addon.core.job.progress_text import time_left
from gskin_addon.core.worker.client import WorkerClient, WorkerError
from gskin_addon.operators import auto_skin
from gskin_addon.operators.auto_skin import SkinOperator, what_is_missing
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import read_weights
from gskin_addon.session import preferences, running_job, skin_job


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """An empty scene with gskin registered, a worker that only pretends, and a job folder of its own."""
    with pretend.session(tmp_path, monkeypatch) as scene:
        yield scene


def add_rod(name: str = "Rod", count: int = 200):
    return create_splat_object(jobs.rod(count)[0], name)


def choose(splats, armature, **settings) -> None:
    chosen = bpy.context.scene.gskin
    chosen.splats, chosen.armature = splats, armature
    for name, value in settings.items():
        setattr(chosen, name, value)


def start(splats, armature, **settings) -> skin_job.SkinJob:
    values = {**bpy.context.scene.gskin.as_job(), **settings}
    job = skin_job.SkinJob.start(splats, armature, values, Path(sys.executable))
    running_job.begin(job)
    return job


def follow(job) -> None:
    wait_until(lambda: not job.step(), "the job does not end")


def wait_for(job, stage: str) -> None:
    def reached() -> bool:
        if job.progress.stage != stage:
            assert job.step(), job.client.error
        return job.progress.stage == stage

    wait_until(reached, f"no stage {stage}")


def untouched(splats) -> bool:
    return (
        not splats.vertex_groups and splats.parent is None and not any(m.type == "ARMATURE" for m in splats.modifiers)
    )


# --- registration, polls


def test_registers_and_unregisters_again_and_again(scene):
    for _ in range(2):
        assert hasattr(bpy.types, "GSKIN_PT_main")
        gskin_addon.unregister()
        assert not hasattr(bpy.types, "GSKIN_PT_main")
        assert not hasattr(bpy.types.Scene, "gskin")
        gskin_addon.register()
    assert scene.gskin.preset == "standard"


def test_settings_offer_what_the_core_has(scene):
    def offered(name: str) -> set[str]:
        return set(scene.gskin.bl_rna.properties[name].enum_items.keys())

    assert offered("preset") == {"draft", "standard", "high", "thorough", "paper"}
    assert "elastic" in offered("guidance")
    assert "oracle" not in offered("guidance")
    assert offered("init") == {"learned", "visibility", "geodesic", "heat"}


def add_mesh():
    mesh = bpy.data.meshes.new("Body")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 0, 1)], [], [(0, 1, 2)])
    obj = bpy.data.objects.new("Body", mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def test_poll_says_what_is_missing(scene, monkeypatch, tmp_path):
    context = bpy.context
    assert "No splats are chosen" in what_is_missing(context)
    with pytest.raises(RuntimeError, match="No splats are chosen"):
        bpy.ops.gskin.auto_skin()
    splats = add_rod()
    choose(splats, None)
    assert "No armature is chosen" in what_is_missing(context)
    armature = add_armature()
    for bone in armature.data.bones:
        bone.use_deform = False
    assert "'Rig' has no deform bones" in what_is_missing(context)
    with pytest.raises(RuntimeError, match="has no deform bones"):
        bpy.ops.gskin.auto_skin()
    armature.data.bones[0].use_deform = True
    assert what_is_missing(context) == ""
    assert bpy.ops.gskin.auto_skin.poll()

    preferences._found.clear()
    monkeypatch.setenv("GSKIN_PYTHON", str(tmp_path / "nothing"))
    assert "nothing" in what_is_missing(context)
    preferences._found.clear()
    monkeypatch.setattr(preferences, "find_worker_python", lambda preference: None)
    monkeypatch.delenv("GSKIN_PYTHON")
    assert what_is_missing(context) == "", "the default needs nothing but Blender"
    scene.gskin.guidance = "elastic"
    assert "No Python with torch" in what_is_missing(context)
    scene.gskin.guidance, scene.gskin.proxy = "none", add_mesh()
    assert "No Python with torch" in what_is_missing(context)


def test_poll_starts_no_process(scene, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise AssertionError("a process was started")

    choose(add_rod(), add_armature())
    preferences._found.clear()
    monkeypatch.setattr(subprocess, "Popen", refuse)
    assert bpy.ops.gskin.auto_skin.poll()


def test_the_selection_stands_for_empty_settings(scene):
    splats, other = add_rod(), add_rod("Other")
    armature = add_armature()
    assert what_is_missing(bpy.context) != ""  # two splat objects, none selected
    other.select_set(True)
    bpy.context.view_layer.objects.active = armature
    assert auto_skin.chosen_splats(bpy.context) == other
    assert auto_skin.chosen_armature(bpy.context) == armature
    scene.gskin.splats = splats
    assert auto_skin.chosen_splats(bpy.context) == splats
    bpy.data.objects.remove(splats)
    assert auto_skin.chosen_splats(bpy.context) == other


def test_a_deleted_object_is_not_chosen(scene):
    splats = add_rod()
    choose(splats, add_armature())
    scene.collection.objects.unlink(splats)  # what Delete does; the setting keeps the data alive
    assert scene.gskin.splats is not None
    assert "No splats" in what_is_missing(bpy.context)


# --- a job that ends well


def test_operator_writes_the_weights(scene, capfd):
    splats, armature = add_rod(), add_armature()
    choose(splats, armature)
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    weights, bones = read_weights(splats)
    assert bones == ["lower", "upper"]
    np.testing.assert_allclose(weights[:, 0], 1.0)
    assert splats.find_armature() == armature
    assert "200 splats follow 2 bones" in running_job.state.outcome
    assert "half" in capfd.readouterr().out
    assert not list(skin_job.jobs_folder().iterdir()), "a finished job is cleared away"


def test_the_job_is_in_world_space(scene, monkeypatch):
    splats, armature = add_rod(), add_armature()
    for obj in (splats, armature):
        obj.location, obj.rotation_euler, obj.scale = (3, 2, 1), (0.3, 0.2, 0.1), (2, 2, 2)
    job = start(splats, armature)
    written = read_job(job.client.folder)
    matrix = np.array(splats.matrix_world)
    means = jobs.rod()[0].means @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(written.cloud.means, means, atol=1e-4)
    np.testing.assert_allclose(written.skeleton.tails[1], matrix @ (0, 0, 2, 1) @ np.eye(4)[:, :3], atol=1e-5)
    follow(job)


def test_objects_may_be_renamed_meanwhile(scene, monkeypatch):
    monkeypatch.setenv("GSKIN_TEST_ACT", "resume")
    splats, armature = add_rod(), add_armature()
    job = start(splats, armature)
    wait_for(job, "step")
    splats.name, armature.name = "New splats", "New rig"
    add_rod("Rod")  # another one takes the old name
    (job.client.folder / "checkpoint" / "go_on").touch()
    follow(job)
    assert "'New rig'" in job.apply()
    assert splats.find_armature() == armature


# --- jobs that do not


@pytest.mark.parametrize("which", ["splats", "armature", "unlinked"])
def test_an_object_is_deleted_meanwhile(scene, monkeypatch, which):
    monkeypatch.setenv("GSKIN_TEST_ACT", "talk")
    splats, armature = add_rod(), add_armature()
    choose(splats, armature)
    job = start(splats, armature)
    wait_for(job, "talk")
    if which == "unlinked":
        scene.collection.objects.unlink(splats)
    else:
        bpy.data.objects.remove({"splats": splats, "armature": armature}[which])
    with pytest.raises(InputError, match=r"'(Rod|Rig)' was deleted"):
        follow(job)
    follow(job)
    assert job.client.state == "cancelled"


def test_splats_are_edited_meanwhile(scene):
    splats, armature = add_rod(), add_armature()
    job = start(splats, armature)
    splats.data.vertices.add(3)
    follow(job)
    with pytest.raises(InputError, match="'Rod' had 200 splats"):
        job.apply()
    assert untouched(splats)


def test_a_bone_is_renamed_meanwhile(scene):
    splats, armature = add_rod(), add_armature()
    job = start(splats, armature)
    armature.data.bones["upper"].name = "top"
    follow(job)
    with pytest.raises(InputError, match="'upper'"):
        job.apply()
    assert untouched(splats)


def test_cancel_writes_nothing_and_the_next_run_goes_on(scene, monkeypatch):
    monkeypatch.setenv("GSKIN_TEST_ACT", "resume")
    splats, armature = add_rod(), add_armature()
    job = start(splats, armature)
    wait_for(job, "step")
    job.cancel()
    follow(job)
    with pytest.raises(Cancelled):
        job.apply()
    assert untouched(splats)
    again = start(splats, armature)
    assert again.client.folder == job.client.folder
    follow(again)
    assert again.client.result().report["settings"]["first"] > 0
    again.apply()
    assert splats.find_armature() == armature


def test_a_failure_brings_its_traceback(scene, monkeypatch, capfd):
    monkeypatch.setenv("GSKIN_TEST_ACT", "raise")
    splats = add_rod()
    choose(splats, add_armature())
    with pytest.raises(RuntimeError, match="the middle of the matter"):
        bpy.ops.gskin.auto_skin()
    assert "fake_worker.py" in running_job.state.details
    assert "fake_worker.py" in capfd.readouterr().out
    assert running_job.state.failed
    assert untouched(splats)


def test_a_worker_killed_in_the_middle_goes_on(scene, monkeypatch):
    monkeypatch.setenv("GSKIN_TEST_ACT", "resume")
    splats, armature = add_rod(), add_armature()
    job = start(splats, armature)
    wait_for(job, "step")
    os.kill(int((job.client.folder / "checkpoint" / "pid").read_text()), signal.SIGKILL)
    follow(job)
    with pytest.raises(WorkerError, match="memory"):
        job.apply()
    assert untouched(splats)
    running_job.end("")
    choose(splats, armature)
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    assert splats.find_armature() == armature


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_blender_is_closed_in_the_middle(scene, tmp_path, monkeypatch):
    """A Python with bpy dies without a goodbye; the worker that it started must not outlive it."""
    script = tmp_path / "session.py"
    script.write_text(
        "import functools, os, pathlib, sys, time\n"
        f"sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(jobs.FAKE.parent)!r}]\n"
        "import bpy, test_auto_skin as t\n"
        "bpy.ops.wm.read_factory_settings(use_empty=True)\n"
        "import gskin_addon; gskin_addon.register()\n"
        f"t.skin_job.jobs_folder = lambda: pathlib.Path({str(tmp_path)!r})\n"
        "t.skin_job.WorkerClient = functools.partial(t.WorkerClient, program=t.jobs.FAKE)\n"
        "job = t.start(t.add_rod(), t.add_armature())\n"
        "t.wait_for(job, 'talk')\n"
        "print('pids', job.client._process.pid, (job.client.folder / 'checkpoint' / 'pid').read_text(), flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    monkeypatch.setenv("GSKIN_TEST_ACT", "talk")
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300)
    pids = next((line.split()[1:] for line in run.stdout.splitlines() if line.startswith("pids")), [])
    assert len(pids) == 2, run.stderr
    wait_until(lambda: not any(_alive(pid) for pid in pids), "the worker outlives its parent")


def _alive(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


# --- bad input


def start_fails(words: str, splats, armature) -> None:
    """The operator says `words` and leaves the scene as it was."""
    choose(splats, armature)
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gskin.auto_skin()
    assert running_job.state.job is None
    assert untouched(splats)


def test_zero_length_bones(scene):
    # Blender drops such bones when it leaves Edit Mode, but applying a scale of 0 makes them.
    armature = add_armature((("level", (0, 0, 0), (1, 0, 0)), ("upright", (1, 0, 0), (1, 0, 1))))
    armature.data.transform(Matrix.Scale(0.0, 4, (0, 0, 1)))
    assert "upright" in armature.data.bones
    start_fails("'upright' of .*'Rig' has zero length", add_rod(), armature)


def test_too_few_splats(scene):
    armature = add_armature()
    start_fails("'One' has 1 splat, nothing to skin", create_splat_object(jobs.rod()[0].select([0]), "One"), armature)
    emptied = add_rod("None")
    emptied.data.clear_geometry()
    start_fails("'None' has no splats", emptied, armature)


def test_armature_that_lies_along_another_axis(scene):
    armature = add_armature((("a", (0, 0, 0), (0, -1, 0)), ("b", (0, -1, 0), (0, -2, 0))))
    start_fails("'Rig' does not overlap 'Rod'.*Up set to -?Y", add_rod(), armature)
    assert "--" not in running_job.state.outcome


def test_armature_elsewhere(scene):
    armature = add_armature()
    armature.location.x = 40
    start_fails("'Rig' does not overlap 'Rod'.*move or scale", add_rod(), armature)


@pytest.mark.parametrize("which", ["Rod", "Rig"])
def test_uneven_scale(scene, which):
    splats, armature = add_rod(), add_armature()
    bpy.data.objects[which].scale = (1, 1, 3)
    start_fails(f"'{which}' is scaled unevenly", splats, armature)


def test_interpreter_without_torch(scene, tmp_path, monkeypatch):
    venv.create(tmp_path / "bare", with_pip=False)
    monkeypatch.setenv("GSKIN_PYTHON", str(tmp_path / "bare" / "bin" / "python"))
    preferences._found.clear()
    monkeypatch.setattr(skin_job, "WorkerClient", WorkerClient)  # the real program
    start_fails(r"lacks .*pip install", add_rod(), add_armature())
    assert "GSKIN_PYTHON" not in running_job.state.outcome


def test_disk_full(scene, monkeypatch):
    def full(*_args, **_kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    splats, armature = add_rod(), add_armature()
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        start_fails("The disk is full", splats, armature)
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}


def test_only_so_many_stopped_jobs_are_kept(scene, tmp_path):
    home = skin_job.jobs_folder()
    for index in range(6):
        (home / f"job{index}").mkdir()
        os.utime(home / f"job{index}", (index, index))
    with job_lock(home / "job1" / "worker.lock"):
        os.utime(home / "job1", (1, 1))
        skin_job.forget_old_jobs(home, keep=3)
    assert sorted(path.name for path in home.iterdir()) == ["job1", "job3", "job4", "job5"]


# --- the modal operator, whose event loop needs a window: its methods, on a stand-in


class Operator:
    """The operator's own methods on an object that Python may make."""

    _job = _timer = _writing = None

    def __init__(self) -> None:
        self.reports: list[tuple[str, str]] = []

    def report(self, kind: set[str], text: str) -> None:
        self.reports.append((next(iter(kind)), text))


for name in ("modal", "cancel", "chosen_rows", "_start", "_write", "_finish", "_fail", "_leave"):
    setattr(Operator, name, SkinOperator.__dict__[name])

TIMER = SimpleNamespace(type="TIMER", value="NOTHING")
ESCAPE = SimpleNamespace(type="ESC", value="PRESS")
OTHER = SimpleNamespace(type="MOUSEMOVE", value="NOTHING")


def until_it_ends(operator: Operator) -> set[str]:
    """What `modal` answers to the last of many ticks of the timer."""
    answers: list[set[str]] = []

    def ended() -> bool:
        answers.append(operator.modal(bpy.context, TIMER))
        return answers[-1] != {"PASS_THROUGH"}

    wait_until(ended, "the operator does not end")
    return answers[-1]


def test_modal_runs_to_the_end_without_blocking(scene):
    splats, armature = add_rod(), add_armature()
    choose(splats, armature)
    operator = Operator()
    assert operator._start(bpy.context)
    assert what_is_missing(bpy.context) == "Auto-Skin is running: wait for it or cancel it"
    assert operator.modal(bpy.context, OTHER) == {"PASS_THROUGH"}
    assert until_it_ends(operator) == {"FINISHED"}
    assert operator.reports[-1][0] == "INFO"
    assert splats.find_armature() == armature
    assert running_job.state.job is None


def test_escape_cancels(scene, monkeypatch):
    monkeypatch.setenv("GSKIN_TEST_ACT", "talk")
    splats = add_rod()
    choose(splats, add_armature())
    operator = Operator()
    assert operator._start(bpy.context)
    wait_for(operator._job, "talk")
    assert operator.modal(bpy.context, ESCAPE) == {"RUNNING_MODAL"}
    assert until_it_ends(operator) == {"CANCELLED"}
    assert operator.reports == [("WARNING", "The job was cancelled.")]
    assert untouched(splats)


def until_writing(operator) -> None:
    """The job has ended and some slices of the weights are done, each tick one."""
    def writing() -> bool:
        if operator._writing is None:
            assert operator.modal(bpy.context, TIMER) == {"PASS_THROUGH"}
        return operator._writing is not None

    wait_until(writing)


def test_weights_are_written_by_ticks_and_nobody_edits_meanwhile(scene, monkeypatch):
    monkeypatch.setattr(auto_skin, "WRITING", 0.0)
    splats, armature = add_rod(), add_armature()
    choose(splats, armature)
    operator, ticks = Operator(), 1
    assert operator._start(bpy.context)
    until_writing(operator)
    assert operator.modal(bpy.context, OTHER) == {"RUNNING_MODAL"}
    assert "Writing the weights" in operator._job.progress.message
    while (answer := operator.modal(bpy.context, TIMER)) == {"PASS_THROUGH"}:
        assert untouched(splats)
        ticks += 1
    assert answer == {"FINISHED"}
    assert ticks >= 3
    assert splats.find_armature() == armature
    assert "200 splats follow 2 bones of 'Rig'" in operator.reports[-1][1]


@pytest.mark.parametrize("how", ["escape", "another file", "a fault"])
def test_stopped_in_the_middle_of_writing_nothing_is_written(scene, monkeypatch, how):
    monkeypatch.setattr(auto_skin, "WRITING", 0.0)
    splats = add_rod()
    choose(splats, add_armature())
    before = {obj.name for obj in bpy.data.objects}, {mesh.name for mesh in bpy.data.meshes}
    operator = Operator()
    assert operator._start(bpy.context)
    until_writing(operator)
    if how == "escape":
        assert operator.modal(bpy.context, ESCAPE) == {"RUNNING_MODAL"}
        assert operator.modal(bpy.context, TIMER) == {"CANCELLED"}
        assert operator.reports == [("WARNING", "The job was cancelled.")]
    elif how == "another file":
        operator.cancel(bpy.context)
    else:
        monkeypatch.setattr(auto_skin, "run_for", None)
        with pytest.raises(TypeError):
            operator.modal(bpy.context, TIMER)
    assert untouched(splats)
    assert ({obj.name for obj in bpy.data.objects}, {mesh.name for mesh in bpy.data.meshes}) == before
    assert running_job.state.job is None


def test_another_file_or_disabling_the_addon_stops_the_worker(scene, monkeypatch):
    monkeypatch.setenv("GSKIN_TEST_ACT", "talk")
    choose(add_rod(), add_armature())
    for leave in (lambda operator: operator.cancel(bpy.context), lambda _: running_job.stop()):
        operator = Operator()
        assert operator._start(bpy.context)
        job = operator._job
        wait_for(job, "talk")
        leave(operator)
        assert running_job.state.job is None
        follow(job)
        assert job.client.state == "cancelled"


def test_what_is_said_of_time():
    assert time_left(None) == "estimating time"
    assert time_left(65.2) == "1:05 left"
    assert time_left(3900) == "1 h 05 min left"


@only_with(*WORKER)
def test_the_real_worker_end_to_end(scene, monkeypatch):
    monkeypatch.setattr(skin_job, "WorkerClient", WorkerClient)
    splats, armature = add_rod(count=400), add_armature()
    choose(splats, armature, preset="draft")
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    weights, _ = read_weights(splats)
    height = jobs.rod(400)[0].means[:, 2]
    assert weights[height < 0.6, 0].min() > 0.9
    assert weights[height > 1.4, 1].min() > 0.9
