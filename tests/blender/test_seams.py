# SPDX-License-Identifier: GPL-3.0-or-later
"""Seams in the window, jobs that know them, and jobs that change a part of the weights."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np
import pretend
import pytest
import worker_jobs as jobs
from patience import wait_until

from gskin_addon.core.job.contract import read_job
from gskin_addon.core.job.scope import read_scope
from gskin_addon.scene import names
from gskin_addon.scene.compared import is_edited
from gskin_addon.scene.seams import read_seams
from gskin_addon.scene.selecting import enter_edit_mode
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import read_weights, write_weights
from gskin_addon.session import skin_job

CHAIN = [(f"bone {i}", (0, 0, 0.25 * i), (0, 0, 0.25 * (i + 1))) for i in range(4)]


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A rod of 200 splats that follows a chain of four bones; a worker that gives all to the first bone."""
    with pretend.session(tmp_path, monkeypatch):
        cloud = jobs.rod(200)[0]
        splats, armature = create_splat_object(cloud, "Rod"), pretend.add_armature(CHAIN)
        height = cloud.means[:, 2]
        share = (height - height.min()) / np.ptp(height) * 3.999
        weights = np.zeros((200, 4), np.float32)
        weights[np.arange(200), share.astype(int)] = 1
        write_weights(splats, armature, weights, [bone[0] for bone in CHAIN])
        chosen = bpy.context.scene.gskin
        chosen.splats, chosen.armature = splats, armature
        bpy.context.view_layer.objects.active = splats
        yield splats, armature, weights


def run(splats, armature, only=None, **settings):
    values = {**bpy.context.scene.gskin.as_job(), **settings}
    job = skin_job.SkinJob.start(splats, armature, values, Path(sys.executable), only=only)
    settings, folder = read_job(job.client.folder).settings, job.client.folder
    scope = read_scope(folder / settings["scope"], 200, 4) if settings.get("scope") else None
    wait_until(lambda: not job.step(), "the job does not end")
    return job.apply(), scope


def select(splats, mask):
    splats.data.vertices.foreach_set("select", mask)
    splats.data.update()


def test_a_seam_goes_into_the_job_and_away_again(scene):
    splats, armature, weights = scene
    top = weights[:, 3] > 0
    select(splats, top)
    bpy.ops.object.mode_set(mode="EDIT")
    # A chain: the first bone is three steps from the last one, so it is foreign.
    assert bpy.ops.gskin.separate_parts(reach=5.0) == {"FINISHED"}
    assert splats.mode == "EDIT"
    bpy.ops.object.mode_set(mode="OBJECT")
    labels = read_seams(splats)
    assert (labels[top] == 1).all()
    assert np.array_equal(labels == 2, weights[:, 0] > 0)
    _, scope = run(splats, armature)
    assert np.array_equal(scope.walls, labels)
    assert np.array_equal(read_seams(splats), labels), "new weights keep the seams"
    assert bpy.ops.gskin.select_seams() == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    select(splats, top)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.gskin.clear_seams()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert np.array_equal(read_seams(splats), np.where(top, 0, labels))
    bpy.ops.gskin.clear_seams()
    assert read_seams(splats) is None
    assert names.SIDE not in splats.data.attributes
    assert run(splats, armature)[1] is None


def test_locked_groups_stay_to_the_bit_when_a_job_runs_again(scene):
    splats, armature, _ = scene
    splats.vertex_groups["bone 2"].add(list(range(0, 200, 7)), 0.3, "REPLACE")
    before = read_weights(splats)[0]
    splats.vertex_groups["bone 2"].lock_weight = True
    said, _ = run(splats, armature)
    after = read_weights(splats)[0]
    assert np.array_equal(after[:, 2], before[:, 2])
    np.testing.assert_allclose(after[:, 0], np.where(before[:, 2] < 1, 1 - before[:, 2], after[:, 0]), atol=1e-6)
    assert "1 locked groups stayed" in said


def test_a_part_of_the_splats_alone(scene):
    splats, armature, _ = scene
    before = read_weights(splats)[0]
    only = np.arange(200) % 2 == 0
    said, scope = run(splats, armature, only)
    after = read_weights(splats)[0]
    assert np.array_equal(after[~only], before[~only])
    assert (after[only, 0] == 1).all()
    assert scope is None, "the default needs no start"
    changed = int((before[only, 0] != 1).sum())
    assert f"{changed} splats of 'Rod' have new weights" in said


def test_a_guidance_starts_from_the_weights_that_are_there(scene):
    splats, armature, weights = scene
    only = np.arange(200) < 50
    _, scope = run(splats, armature, only, guidance="elastic")
    assert np.array_equal(scope.only, np.arange(50))
    np.testing.assert_allclose(scope.present, weights, atol=1e-6)


def test_a_guidance_starts_with_splats_that_have_no_weights(scene):
    """The weight tools leave splats without weights as they are, so a job has to take them so."""
    splats, armature, weights = scene
    empty = np.arange(200) % 5 == 0
    for group in splats.vertex_groups:
        group.remove(np.flatnonzero(empty).tolist())
    only = np.arange(200) < 50
    _, scope = run(splats, armature, only, guidance="elastic")
    np.testing.assert_allclose(scope.present, np.where(empty[:, None], 0, weights), atol=1e-6)
    after = read_weights(splats)[0]
    assert (after[only, 0] == 1).all()
    assert not after[empty & ~only].any(), "what was not selected stays"


def test_hand_work_is_kept_beside_new_weights_and_blends_with_them(scene):
    splats, armature, _ = scene
    assert not is_edited(splats)
    select(splats, np.arange(200) < 30)
    bpy.ops.gskin.flood_weights(bone="bone 2", weight=0.5)
    assert is_edited(splats)
    mine = read_weights(splats)[0]
    run(splats, armature)
    assert not is_edited(splats)
    theirs = read_weights(splats)[0]
    assert (theirs[:, 0] == 1).all()
    assert bpy.ops.gskin.compare_weights(show="BEFORE") == {"FINISHED"}
    assert np.array_equal(read_weights(splats)[0], mine)
    bpy.ops.gskin.compare_weights(show="RESULT")
    assert bpy.ops.gskin.blend_weights(factor=0.25) == {"FINISHED"}
    np.testing.assert_allclose(read_weights(splats)[0], 0.75 * theirs + 0.25 * mine, atol=1e-6)


def test_refine_selected_changes_the_selection_alone(scene):
    splats, _armature, _ = scene
    before = read_weights(splats)[0]
    only = np.arange(200) >= 150
    select(splats, only)
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.gskin.refine_selected() == {"FINISHED"}
    after = read_weights(splats)[0]
    assert np.array_equal(after[~only], before[~only])
    assert (after[only, 0] == 1).all()
    select(splats, np.zeros(200, bool))
    with pytest.raises(RuntimeError, match="No splats of 'Rod' are selected"):
        bpy.ops.gskin.refine_selected()


def triangles(mesh):
    return {frozenset(triangle.vertices) for triangle in mesh.polygons}


def test_a_seam_frees_both_sides_and_cuts_the_fabric(scene):
    splats, _armature, weights = scene
    top = weights[:, 3] > 0
    wrong = weights.copy()
    low = np.flatnonzero(weights[:, 0] > 0)
    wrong[low[::2]] = [0.25, 0, 0, 0.75]  # the last bone drags every other splat of the first
    write_weights(splats, scene[1], wrong, [bone[0] for bone in CHAIN])
    bpy.ops.gskin.make_paintable()
    splats.vertex_groups["bone 1"].lock_weight = True
    select(splats, top)
    sewn = splats.data.copy()
    bpy.ops.gskin.separate_parts(reach=5.0, free=False)
    assert np.array_equal(read_weights(splats)[0], wrong), "only marked"
    labels = read_seams(splats)
    edges = np.array([edge.vertices[:] for edge in splats.data.edges])
    sides = labels[edges]
    assert len(edges)
    assert not ((sides[:, 0] != sides[:, 1]) & (sides != 0).all(axis=1)).any()
    cut, splats.data = splats.data, sewn
    enter_edit_mode(bpy.context, splats, top)
    bpy.ops.gskin.separate_parts(reach=5.0, free=False)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert np.array_equal(read_seams(splats), labels)
    assert len(splats.data.vertices) == len(cut.vertices)
    assert triangles(splats.data) == triangles(cut), "the same in Edit Mode"
    select(splats, top)
    bpy.ops.gskin.separate_parts(reach=5.0)
    after = read_weights(splats)[0]
    other = read_seams(splats) == read_seams(splats).max()
    assert other[low].mean() > 0.8
    assert (wrong[other, 3] > 0).sum() > 10
    assert after[other, 3].max() == 0
    np.testing.assert_allclose(after[other].sum(axis=1), 1, atol=1e-5)
    assert np.array_equal(after[top], wrong[top])
