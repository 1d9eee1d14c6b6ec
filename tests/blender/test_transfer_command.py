# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin weights --from-mesh`, `--from-splats`, `--to-mesh`: files of Blender's own exporters, of RigNet, and ours."""

from __future__ import annotations

import numpy as np
import pytest
from proxy_meshes import tube

bpy = pytest.importorskip("bpy")

from gskin_addon import cli
from gskin_addon.core.job.skinned_files import read_skinned
from gskin_addon.core.rig.rignet_file import read_rignet, write_rignet
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.splats.from_mesh import sample_mesh
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.gltf_export import export_glb
from gskin_addon.scene.proxy_object import bind_proxy, create_mesh_object
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import write_weights

BONES = ("hip bone", "middle", "end")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder: body.glb and body.txt with body.obj, a skinned tube; old.blend and old.glb, splats on it with its
    weights; new.blend, other splats with none to speak of; and the true weights of the new splats."""
    folder = tmp_path_factory.mktemp("transfer")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    data = bpy.data.armatures.new("Rig")
    armature = bpy.data.objects.new("Rig", data)
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for k, name in enumerate(BONES):
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = (k, 0, 1), (k + 1, 0, 1)
        bone.parent = data.edit_bones[BONES[k - 1]] if k else None
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.location = (0.5, 2, 0)

    verts, faces = tube(3, 31, 12, 0.2)
    verts[:12, 1:] = verts[-12:, 1:] = 0
    near = np.exp(-6 * np.maximum(np.abs(verts[:, :1] - [0.5, 1.5, 2.5]) - 0.4, 0))
    near[near < 0.02] = 0
    weights = (near / near.sum(1, keepdims=True)).astype(np.float32)
    verts = verts + [0.5, 2, 1]
    mesh = create_mesh_object("Body", verts, faces)
    bind_proxy(mesh, armature, weights, BONES)
    bpy.ops.export_scene.gltf(filepath=str(folder / "body.glb"), export_yup=True)
    write_rignet(folder / "body.txt", weights, read_skeleton(armature))
    lines = [f"v {x} {z} {-y}" for x, y, z in verts.tolist()] + [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    (folder / "body.obj").write_text("\n".join(lines))
    bpy.data.objects.remove(mesh)

    def splats(name, seed):
        rng = np.random.default_rng(seed)
        cloud, face, bary = sample_mesh(verts, faces, np.full((len(faces), 3, 3), 0.5), 900, rng, below=0)
        return create_splat_object(cloud, name), np.einsum("nk,nkb->nb", bary, weights[faces[face]])

    old, its = splats("Old", 0)
    write_weights(old, armature, its.astype(np.float32), BONES)
    export_glb(folder / "old.glb", [old])
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "old.blend"))
    bpy.data.objects.remove(old)
    new, truth = splats("New", 1)
    write_weights(new, armature, np.tile(np.float32([1, 0, 0]), (900, 1)), BONES)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "new.blend"))
    return folder, truth, verts, faces, weights


def run(capsys, *words):
    code = cli.main(["weights", *map(str, words)])
    return code, capsys.readouterr().err


def test_blenders_own_glb_stands_where_blender_had_it(files):
    folder, _, verts, _, _ = files
    mesh = read_skinned(folder / "body.glb")
    assert set(mesh.bones) == set(BONES)
    away = np.linalg.norm(mesh.verts[:, None] - verts[None], axis=2).min(axis=1)
    assert away.max() < 1e-5


@pytest.mark.parametrize("name", ["body.glb", "body.txt"])
def test_weights_from_a_skinned_mesh(files, tmp_path, capsys, name):
    folder, truth, *_ = files
    if name == "body.txt":  # its names have no spaces
        text = (folder / name).read_text().replace("hip_bone", "hip")
        (folder / "named.txt").write_text(text)
        (folder / "named.obj").write_text((folder / "body.obj").read_text())
        name = "named.txt"
    out = tmp_path / "w.npz"
    code, said = run(capsys, folder / "new.blend", "--from-mesh", folder / name, "--weights", out)
    assert code == 0, said
    after = read_weights_file(out).weights
    if name == "named.txt":
        assert "weights of 'hip' were left out" in said
        there = truth[:, 0] < 0.3
        assert np.abs(after - truth)[there].sum(1).mean() < 0.6
    else:
        assert np.abs(after - truth).sum(1).mean() < 0.05


@pytest.mark.parametrize("name", ["old.blend", "old.glb"])
def test_weights_from_other_splats_for_a_selection(files, tmp_path, capsys, name):
    folder, truth, *_ = files
    (tmp_path / "half.txt").write_text(" ".join(map(str, range(450, 900))))
    out = tmp_path / "w.npz"
    words = ("--from-splats", folder / name, "--select", tmp_path / "half.txt", "--weights", out)
    code, said = run(capsys, folder / "new.blend", *words)
    assert code == 0, said
    after = read_weights_file(out).weights
    assert (after[:450] == [1, 0, 0]).all()
    assert np.abs(after - truth)[450:].sum(1).mean() < 0.08


def test_weights_for_a_mesh_as_rignets_text(files, tmp_path, capsys):
    folder, _, verts, _, weights = files
    code, said = run(capsys, folder / "old.blend", "--to-mesh", folder / "body.obj", tmp_path / "mesh.txt")
    assert code == 0, said
    rig = read_rignet(tmp_path / "mesh.txt")
    assert rig.bones == ("hip_bone", "middle", "end")
    assert rig.weights.shape == (len(verts), 3)
    assert np.abs(rig.weights - weights).sum(1).mean() < 0.1


def test_a_mesh_comes_out_skinned(files, tmp_path, capsys):
    folder, _, verts, faces, weights = files
    words = ("--to-mesh", folder / "body.obj", tmp_path / "mesh.glb", "--out", tmp_path / "out.blend")
    code, said = run(capsys, folder / "old.blend", *words)
    assert code == 0, said
    mesh = read_skinned(tmp_path / "mesh.glb")
    assert len(mesh.faces) == len(faces)
    away = np.linalg.norm(mesh.verts[:, None] - verts[None], axis=2)
    assert away.min(axis=1).max() < 1e-5
    expected = weights[away.argmin(axis=1)]
    order = [mesh.bones.index(name) for name in BONES]
    assert np.abs(mesh.weights[:, order] - expected).sum(1).mean() < 0.1
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out.blend"))
    assert "mesh" not in bpy.data.objects, "the splats' file has no mesh that nobody asked for"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--from-mesh", "none.glb"), "none.glb"),
        (("--from-mesh", "body.obj"), "give one of"),
        (("--from-splats", "body.obj"), "neither .blend nor .glb"),
        (("--from-splats", "body.glb"), "no skinned splats"),
        (("--to-mesh", "body.obj", "x.ply"), "must end in .npz or .txt or .glb"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(files, tmp_path, capsys, words, said):
    folder = files[0]
    paths = [folder / word if "." in word else word for word in words]
    code, text = run(capsys, folder / "new.blend", *paths, "--weights", tmp_path / "w.npz")
    assert (code, said in text, text.count("\n")) == (2, True, 1), text
