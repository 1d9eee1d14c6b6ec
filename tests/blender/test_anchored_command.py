# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin rig --mesh`: from a mesh file to splats that hang on it, posed and saved."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from proxy_meshes import tube

bpy = pytest.importorskip("bpy")

from rig_scenes import posed_in_blender

from gskin_addon import cli
from gskin_addon.core.job.contract import read_job, read_result, write_result
from gskin_addon.core.job.mesh_files import read_mesh
from gskin_addon.core.rig.anchoring import pose_anchored
from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.scene.anchored import has_edges_only, proxy_of, read_anchors
from gskin_addon.scene.attributes import read_positions
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.splat_object import is_splat_object
from gskin_addon.session import skin_job
from tests.helpers.limb import make_limb


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A limb as .ply, its armature, its mesh as y-up .glb; and a worker that answers at once."""
    trimesh = pytest.importorskip("trimesh")
    limb = make_limb(400)
    write_ply(tmp_path / "limb.ply", limb.cloud)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for k, name in enumerate(limb.skeleton.names):
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail = (k, 0, 0), (k + 1, 0, 0)
        bone.parent = armature.data.edit_bones.get(f"bone{k - 1}")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"), copy=True)
    verts, faces = tube(rings=37)
    yup = np.stack([verts[:, 0], verts[:, 2], -verts[:, 1]], axis=1)
    trimesh.Trimesh(yup, faces, process=False).export(tmp_path / "body.glb")

    class Worker:
        """Writes the answer at once, without a process."""

        def __init__(self, python, folder, **_):
            self.folder = folder

        def start(self):
            job = read_job(self.folder)
            points, _ = read_mesh(self.folder / job.settings["mesh"])
            weights = np.exp(-6 * np.square(points[:, :1] - [0.5, 1.5, 2.5])).astype(np.float32)
            weights /= weights.sum(axis=1, keepdims=True)
            write_result(job, limb.weights, {}, {}, weights)

        def wait(self, show):
            return read_result(self.folder)

    monkeypatch.setattr(skin_job, "WorkerClient", Worker)
    return tmp_path


def rig(files, out, *options):
    return cli.main(
        ["rig", str(files / "limb.ply"), "--armature", str(files / "rig.blend"), "--out", str(files / out),
         "--mesh", str(files / "body.glb"), "--python", sys.executable, "--progress", "none", *options]
    )  # fmt: skip


def covariances(cloud):
    """(N, 3, 3)"""
    axes = quat_to_matrix(cloud.quats.astype(np.float64)) * cloud.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_rigged_splats_hang_on_the_mesh_and_pose_like_the_core(files):
    assert rig(files, "out.blend", "--weights", str(files / "w.npz")) == 0
    assert read_weights_file(files / "w.npz").mesh_weights.shape == (37 * 12, 3)
    turn = ["--rotate", "bone1", "0", "0", "60"]
    assert cli.main(["pose", str(files / "out.blend"), "--out", str(files / "posed.ply"), *turn]) == 0
    obj = next(obj for obj in bpy.data.objects if is_splat_object(obj))
    assert proxy_of(obj).name == "body"
    cloud = posed_cloud(obj)
    np.testing.assert_allclose(read_ply(files / "posed.ply").cloud.means, cloud.means, atol=1e-6)
    rest = read_ply(files / "limb.ply").cloud
    assert np.linalg.norm(cloud.means - rest.means, axis=1).max() > 1
    assert np.abs(cloud.scales / rest.scales - 1).max() > 0.05
    points, _ = posed_in_blender(obj)
    assert np.abs(points - cloud.means).max() < 1e-5 * 3


def test_the_edges_alone_turn_and_shear_the_splats_where_it_is_asked(files, capsys):
    turn = ["--rotate", "bone1", "0", "0", "60"]
    posed = []
    for number, options in enumerate(([], ["--edges-only"])):
        assert rig(files, f"{number}.blend", *options, "--job-dir", str(files / f"job{number}")) == 0
        assert read_job(files / f"job{number}").settings.get("edges_only", False) == bool(options)
        assert cli.main(["pose", str(files / f"{number}.blend"), "--out", str(files / "posed.ply"), *turn]) == 0
        obj = next(obj for obj in bpy.data.objects if is_splat_object(obj))
        assert has_edges_only(obj) == bool(options)
        anchors, verts, faces = read_anchors(obj)
        proxy = proxy_of(obj).evaluated_get(bpy.context.evaluated_depsgraph_get())
        moved = read_positions(proxy.data).astype(np.float64)
        rest = read_ply(files / "limb.ply").cloud
        wanted = pose_anchored(rest, anchors, verts, moved, faces, edges_only=bool(options))
        got = read_ply(files / "posed.ply").cloud
        np.testing.assert_allclose(got.means, wanted.means, atol=1e-5)
        np.testing.assert_allclose(covariances(got), covariances(wanted), atol=1e-5 * covariances(rest).max())
        posed.append(covariances(got))
    assert np.abs(posed[0] - posed[1]).max() > 1e-3 * np.abs(posed[0]).max()
    command = ["rig", str(files / "limb.ply"), "--armature", str(files / "rig.blend"), "--out", str(files / "c.blend")]
    assert cli.main([*command, "--edges-only"]) == 2
    assert "--edges-only is about a proxy mesh; name one with --mesh" in capsys.readouterr().err


def test_a_glb_gets_the_splats_own_weights(files):
    assert rig(files, "out.glb") == 0
    assert (files / "out.glb").stat().st_size > 1000


def test_a_mesh_that_is_none_is_one_sentence(files, capsys):
    (files / "body.glb").write_bytes(b"no")
    assert rig(files, "out.blend") == 2
    assert "body.glb' cannot be read as a mesh" in capsys.readouterr().err
    assert not (files / "out.blend").exists()
