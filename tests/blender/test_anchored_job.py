# SPDX-License-Identifier: GPL-3.0-or-later
"""Auto-Skin with a proxy mesh: what the worker is asked, and what the scene gets."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import worker_jobs as jobs
from proxy_meshes import tube

bpy = pytest.importorskip("bpy")

import pretend

from gskin_addon.core.errors import InputError
from gskin_addon.core.job.contract import read_job
from gskin_addon.core.job.mesh_files import read_mesh
from gskin_addon.scene import names, weights
from gskin_addon.scene.anchored import has_edges_only, proxy_of
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.bone_frames import armature_of, is_bone_frames
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import read_weights
from gskin_addon.session.skin_job import SkinJob


@pytest.fixture
def scene(tmp_path, monkeypatch):
    with pretend.session(tmp_path, monkeypatch) as scene:
        verts, faces = tube(bones=2, rings=9, sides=6)
        mesh = bpy.data.meshes.new("Body")
        mesh.from_pydata((verts[:, [1, 2, 0]] / 2).tolist(), [], faces.tolist())
        body = bpy.data.objects.new("Body", mesh)
        body.scale = (2, 2, 2)
        bpy.context.scene.collection.objects.link(body)
        settings = scene.gskin
        settings.splats = create_splat_object(jobs.rod(200)[0], "Rod")
        settings.armature = pretend.add_armature()
        settings.proxy = body
        yield settings


def test_the_mesh_gets_weights_and_the_splats_follow_it(scene):
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    splats, body = scene.splats, scene.proxy
    assert proxy_of(splats) == body
    assert armature_of(body) == scene.armature
    on_mesh, bones = read_weights(body)
    assert bones == ["lower", "upper"]
    np.testing.assert_array_equal(on_mesh, np.tile([1, 0], (54, 1)))
    np.testing.assert_allclose(body.matrix_world, np.diag([2, 2, 2, 1]), atol=1e-6)
    assert {group.name for group in splats.vertex_groups} == {"lower", "upper"}


def test_the_job_holds_the_mesh_in_world_space(scene):
    job = SkinJob.start(scene.splats, scene.armature, scene.as_job(), sys.executable, scene.proxy)
    try:
        asked = read_job(job.client.folder)
        verts, faces = read_mesh(job.client.folder / asked.settings["mesh"])
        assert len(faces) == 96
        np.testing.assert_allclose(verts.max(axis=0)[2], 2, atol=1e-6)
    finally:
        job.client.stop()


def test_edges_only_goes_into_the_job_and_onto_the_splats(scene):
    assert "edges_only" not in scene.as_job()
    scene.edges_only = True
    assert scene.as_job()["edges_only"] is True
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    assert has_edges_only(scene.splats)
    scene.proxy = None
    assert "edges_only" not in scene.as_job()


def test_a_mesh_changed_meanwhile_changes_nothing(scene):
    job = SkinJob.start(scene.splats, scene.armature, scene.as_job(), sys.executable, scene.proxy)
    scene.proxy.data.vertices.add(1)
    while job.step():
        pass
    with pytest.raises(InputError, match="'Body' has 55 points and the weights are for 54"):
        job.apply()
    assert proxy_of(scene.splats) is None
    assert not scene.splats.vertex_groups


def untouched(scene) -> bool:
    objects = scene.splats, scene.proxy
    return not any(obj.vertex_groups or obj.parent or obj.find_armature() for obj in objects)


def finished_job(scene) -> SkinJob:
    job = SkinJob.start(scene.splats, scene.armature, scene.as_job(), sys.executable, scene.proxy)
    while job.step():
        pass
    return job


def test_a_mesh_that_cannot_be_anchored_to_gets_no_weights_either(scene):
    job = finished_job(scene)
    scene.proxy.modifiers.new("Smooth", "SUBSURF")
    with pytest.raises(InputError, match="'Body' has modifiers that change its points"):
        job.apply()
    assert untouched(scene)
    assert proxy_of(scene.splats) is None


def test_stopped_after_any_slice_neither_object_is_changed(scene):
    job = finished_job(scene)
    before = {obj.name for obj in bpy.data.objects}, {mesh.name for mesh in bpy.data.meshes}
    done = 0
    while True:
        steps = job.apply_steps()
        try:
            for _ in range(done + 1):
                next(steps)
        except StopIteration:
            break
        assert untouched(scene)
        steps.close()
        assert ({obj.name for obj in bpy.data.objects}, {mesh.name for mesh in bpy.data.meshes}) == before
        done += 1
    assert done >= 5
    assert proxy_of(scene.splats) == scene.proxy


def test_splats_on_a_mesh_get_no_modifiers_that_would_be_taken_off_again(scene, monkeypatch):
    monkeypatch.setattr(weights, "bind", None)
    finished_job(scene).apply()
    assert [m.name for m in scene.splats.modifiers] == ["GSkin Anchor", "GSkin Display"]
    assert not any(is_bone_frames(obj) for obj in bpy.data.objects)
    assert scene.splats.parent == scene.proxy.parent == scene.armature
    stored = read_attribute(scene.splats.data, names.BONE.format(0))
    np.testing.assert_array_equal(stored, 0)  # the display by bones shows them


def test_a_mesh_with_a_parent_keeps_it(scene):
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    scene.proxy.parent = parent
    finished_job(scene).apply()
    assert scene.proxy.parent == parent
    assert armature_of(scene.proxy) == scene.armature
