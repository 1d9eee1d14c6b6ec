# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch
from proxy_meshes import tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.job.contract import read_job, write_job, write_result
from gskin_addon.core.job.mesh_files import read_mesh, write_mesh
from gskin_addon.core.pipeline import steps
from gskin_addon.core.pipeline.proxy import Proxy
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.poses import random_poses
from gskin_addon.core.rig.weights_file import read_weights_file, write_weights_file
from gskin_addon.core.skinning import presets
from gskin_addon.core.skinning.posers import AnchoredPoser
from gskin_addon.core.skinning.subset import SplatSubset
from tests.helpers.limb import make_limb

TINY = presets.Preset("for tests", 4, ((64, 6), (128, 10)), 4)


def silent(*_):
    return None


def test_a_job_with_a_mesh_learns_on_its_vertices(tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", TINY)
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 128)
    limb = make_limb(1500)
    verts, faces = tube(rings=37)
    folder = tmp_path / "job"
    mesh = write_mesh(folder, verts, faces)
    settings = {"preset": "draft", "guidance": "elastic", "mesh": mesh}
    write_job(folder, limb.cloud, limb.skeleton, settings)
    job = read_job(folder)
    job.checkpoint.mkdir()
    outcome = run(job.cloud, job.skeleton, job.settings, silent, job.checkpoint)
    assert outcome.mesh_weights.shape == (len(verts), 3)
    assert (outcome.mesh_weights > 0).sum(axis=1).max() <= 4
    np.testing.assert_allclose(outcome.mesh_weights.sum(axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(outcome.weights.sum(axis=1), 1, atol=1e-5)
    losses = outcome.report["losses"]
    assert losses[-1]["render"] < losses[0]["render"]
    assert outcome.report["mesh"]["vertices"] == len(verts)
    rng = np.random.default_rng(1)
    poses = pose_transforms(limb.skeleton, random_poses(limb.skeleton, (0, 1, 0), 20, rng))
    moved = [skin_points(limb.cloud.means, w, poses) for w in (outcome.weights, limb.weights)]
    assert np.linalg.norm(moved[0] - moved[1], axis=-1).mean() < 0.05
    write_result(job, outcome.weights, outcome.report, outcome.previews, outcome.mesh_weights)
    np.testing.assert_array_equal(read_weights_file(folder / "weights.npz").mesh_weights, outcome.mesh_weights)


def test_edges_only_is_what_the_poser_learns_with(tmp_path):
    limb = make_limb(300)
    verts, faces = tube(rings=13)
    path = tmp_path / write_mesh(tmp_path, verts, faces)
    rng = np.random.default_rng(0)
    for edges_only in (False, True):
        proxy = Proxy.load(path, limb.cloud, edges_only=edges_only)
        subset = SplatSubset(np.arange(300), limb.cloud, limb.cloud)
        poser = proxy.poser(subset)
        own = AnchoredPoser(limb.cloud, proxy.anchors, proxy.verts, proxy.faces, edges_only=edges_only)
        other = AnchoredPoser(limb.cloud, proxy.anchors, proxy.verts, proxy.faces, edges_only=not edges_only)
        weights = torch.from_numpy(rng.dirichlet(np.ones(3), len(verts)).astype(np.float32))
        pose = pose_transforms(limb.skeleton, random_poses(limb.skeleton, (0, 1, 0), 2, rng)).astype(np.float32)
        quats = [each.pose(weights, pose).quats.numpy() for each in (poser, own, other)]
        np.testing.assert_array_equal(quats[0], quats[1])
        assert np.abs(quats[0] - quats[2]).max() > 1e-3
        assert proxy.summary()["edges_only"] is edges_only


def test_weights_files_without_a_mesh_have_none_and_bad_ones_are_refused(tmp_path):
    limb = make_limb(20)
    write_weights_file(tmp_path / "w.npz", limb.weights, limb.skeleton)
    assert read_weights_file(tmp_path / "w.npz").mesh_weights is None
    with pytest.raises(ValueError, match="for 3 bones"):
        write_weights_file(tmp_path / "w.npz", limb.weights, limb.skeleton, np.ones((4, 2)))


def test_meshes_are_read_from_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    verts, faces = tube(rings=5, sides=6)
    name = write_mesh(tmp_path, verts, faces)
    assert name == write_mesh(tmp_path, verts, faces) != write_mesh(tmp_path, verts * 2, faces)
    np.testing.assert_array_equal(read_mesh(tmp_path / name)[0], verts)
    for suffix in ("obj", "ply", "glb", "stl"):
        path = tmp_path / f"mesh.{suffix}"
        trimesh.Trimesh(verts, faces, process=False).export(path)
        found, triangles = read_mesh(path)
        assert len(found) == len(verts), suffix
        corners = [np.sort(points[index].sum(axis=1), axis=0) for points, index in ((verts, faces), (found, triangles))]
        np.testing.assert_allclose(*corners, atol=1e-5)


def test_files_that_are_no_mesh_are_named(tmp_path):
    with pytest.raises(InputError, match=r"nothing\.obj' does not exist"):
        read_mesh(tmp_path / "nothing.obj")
    for name, words in (("a.npz", "needs the arrays verts and faces"), ("b.glb", "cannot be read as a mesh")):
        (tmp_path / name).write_bytes(b"this is no mesh")
        with pytest.raises(InputError, match=rf"{name}.*{words}"):
            read_mesh(tmp_path / name)
    np.savez(tmp_path / "c.npz", verts=np.eye(3))
    with pytest.raises(InputError, match="needs the arrays verts and faces"):
        read_mesh(tmp_path / "c.npz")
    (tmp_path / "d.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(InputError, match=r"d\.obj"):
        read_mesh(tmp_path / "d.obj")
    limb = make_limb(50)
    with pytest.raises(InputError, match="mesh is 3"):
        run(limb.cloud, limb.skeleton, {"mesh": 3}, silent, tmp_path)
