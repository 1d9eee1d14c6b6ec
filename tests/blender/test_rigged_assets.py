# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged models of files as assets to train on."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from gskin_addon.commands.import_rigged import PROGRAM
from gskin_addon.core.errors import InputError
from gskin_addon.core.training.catalogue import list_assets
from gskin_addon.core.training.rigged import load_asset, read_rigged_mesh
from gskin_addon.core.training.textures import to_srgb
from gskin_addon.scene.rigged_assets import import_rigged

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).parents[3] / "shared/assets"))
HEAD_TINT = 0.25


def make_character():
    """A box of two halves on two bones, the lower textured, the upper red by vertex colours; a hat on a bone."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for k, name in enumerate(("low", "high")):
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail = (0, 0, k), (0, 0, k + 1)
        bone.parent = armature.data.edit_bones.get("low") if k else None
    bpy.ops.object.mode_set(mode="OBJECT")

    square = np.array([[-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])
    verts = [(x, y, z) for z in (0, 1, 2) for x, y in square]
    sides = [(i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i) for i in range(4)]
    faces = [tuple(4 * k + corner for corner in side) for k in range(2) for side in sides]
    mesh = bpy.data.meshes.new("Body")
    mesh.from_pydata(verts, [], faces)
    body = bpy.data.objects.new("Body", mesh)
    bpy.context.scene.collection.objects.link(body)
    body.parent = armature
    body.modifiers.new("Armature", "ARMATURE").object = armature
    for name, share in (("low", (1.0, 0.5, 0.0)), ("high", (0.0, 0.5, 1.0))):
        group = body.vertex_groups.new(name=name)
        for vertex in range(12):
            group.add((vertex,), share[vertex // 4], "REPLACE")
    uv = mesh.uv_layers.new(name="UVMap")
    for loop in mesh.loops:
        x, y, z = verts[loop.vertex_index]
        uv.data[loop.index].uv = ((x + y) * 1.2 + 0.5, z / 2)
    colors = mesh.color_attributes.new("Col", "FLOAT_COLOR", "CORNER")
    for face in mesh.polygons:
        for loop in face.loop_indices:  # glTF multiplies the picture by them, too
            tint = 1.0 if face.index < 4 else HEAD_TINT
            colors.data[loop].color = (tint, tint, tint, 1)
    picture = bpy.data.images.new("Checks", 8, 4)
    pixels = np.ones((4, 8, 4), np.float32)
    pixels[..., 0], pixels[..., 1] = np.linspace(0, 1, 8), np.linspace(0, 1, 4)[:, None]
    picture.pixels.foreach_set(pixels.ravel())
    picture.pack()
    for name in ("Checked", "Tinted"):
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        tree = material.node_tree
        shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
        if name == "Checked":
            source = tree.nodes.new("ShaderNodeTexImage")
            source.image = picture
        else:
            source = tree.nodes.new("ShaderNodeVertexColor")
            source.layer_name = "Col"
        tree.links.new(source.outputs["Color"], shader.inputs["Base Color"])
        mesh.materials.append(material)
    for face in mesh.polygons:
        face.material_index = int(face.index >= 4)
    hat = bpy.data.meshes.new("Hat")
    hat.from_pydata([(0, 0, 2), (0.1, 0, 2.2), (0, 0.1, 2.2)], [], [(0, 1, 2)])
    hat = bpy.data.objects.new("Hat", hat)
    bpy.context.scene.collection.objects.link(hat)
    hat.parent, hat.parent_type, hat.parent_bone = armature, "BONE", "high"
    bpy.context.view_layer.update()
    hat.matrix_world = np.eye(4)
    bone = armature.pose.bones["high"]
    bone.rotation_mode = "XYZ"
    for name, far in (("Nod", 0.2), ("Bow", 1.2)):
        armature.animation_data_create().action = bpy.data.actions.new(name)
        for frame, angle in ((1, 0.0), (24, far)):
            bone.rotation_euler = (angle, 0.3, 0)
            bone.keyframe_insert("rotation_euler", frame=frame)
        armature.animation_data.action.use_fake_user = True
    bpy.context.scene.frame_set(17)  # the pose of the file is not its rest
    bpy.context.view_layer.update()
    return armature


def write_vrm(glb, vrm):
    """The same as a VRM has it: an extension of its own, and materials without light."""
    data = glb.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    table = json.loads(data[20 : 20 + size])
    table["extensionsUsed"] = [*table.get("extensionsUsed", []), "VRM", "KHR_materials_unlit"]
    table["extensions"] = {"VRM": {"specVersion": "0.0", "exporterVersion": "a test"}}
    for material in table["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    vrm.write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text + rest)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The character as .blend, .glb, .vrm and .fbx."""
    folder = tmp_path_factory.mktemp("characters")
    make_character()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "figure.blend"), check_existing=False)
    bpy.ops.export_scene.gltf(filepath=str(folder / "figure.glb"), export_current_frame=False)
    write_vrm(folder / "figure.glb", folder / "figure.vrm")
    bpy.ops.export_scene.fbx(
        filepath=str(folder / "figure.fbx"), path_mode="COPY", embed_textures=True, add_leaf_bones=False
    )
    return folder


@pytest.mark.parametrize("ending", ["blend", "glb", "vrm", "fbx"])
def test_a_character_of_any_file_is_an_asset(files, ending, tmp_path):
    asset = import_rigged(files / f"figure.{ending}")
    np.savez(tmp_path / "a.npz", **asset.arrays)
    mesh = read_rigged_mesh(tmp_path / "a.npz")
    assert mesh.skeleton.names == ("low", "high")
    assert mesh.skeleton.parents.tolist() == [-1, 0]
    np.testing.assert_allclose(mesh.skeleton.heads, [[0, 0, 0], [0, 0, 1]], atol=1e-5)
    assert mesh.used.all()
    # At rest, upright, whatever the pose; the hat is where it was.
    np.testing.assert_allclose(mesh.verts.min(0), [-0.2, -0.2, 0], atol=1e-4)
    np.testing.assert_allclose(mesh.verts.max(0), [0.2, 0.2, 2.2], atol=1e-4)
    np.testing.assert_allclose(mesh.weights.sum(1), 1, atol=1e-6)
    wanted = np.clip(mesh.verts[:, 2], 0, 2) / 2
    np.testing.assert_allclose(mesh.weights[:, 1], wanted, atol=1e-4)
    # The lower half has the picture, the upper vertex colours, both in sRGB.
    low = np.flatnonzero(mesh.verts[mesh.faces][..., 2].max(1) < 1.1)
    assert len(low) == 8
    has, colors = mesh.textures.colors(low, np.full((8, 3), 1 / 3))
    assert has.all()
    at = mesh.verts[mesh.faces[low]].mean(1)
    np.testing.assert_allclose(colors[:, 0], (((at[:, 0] + at[:, 1]) * 1.2 + 0.5) * 8 - 0.5) / 7, atol=0.03)
    np.testing.assert_allclose(colors[:, 1], np.clip(at[:, 2] / 2 * 4 - 0.5, 0, 3) / 3, atol=0.03)
    tall = mesh.verts[mesh.faces][..., 2]
    high = np.flatnonzero((tall.min(1) > 0.9) & (tall.max(1) < 2.1))
    if ending != "fbx":  # which has no word for materials that show vertex colours
        np.testing.assert_allclose(mesh.corner_rgb[high], to_srgb(np.array(HEAD_TINT)), atol=0.01)
        assert not mesh.textures.colors(high, np.full((len(high), 3), 1 / 3))[0].any()


def test_a_mirrored_character_shows_its_outside(tmp_path):
    """Splats are drawn below the surface that the triangles' order says, and colours stay at their corners."""
    made = {}
    for mirrored in (False, True):
        make_character()
        bpy.data.objects["Rig"].scale = (-1 if mirrored else 1, 1, 1)
        path = tmp_path / f"{mirrored}.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
        made[mirrored] = import_rigged(path).arrays
    plain, turned = made[False], made[True]
    corner = turned["verts"][turned["faces"]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    outwards = (normal * (corner.mean(axis=1) - turned["verts"].mean(axis=0)))[:, :2].sum(axis=1)
    sides = np.abs(normal[:, 2]) < 1e-9
    assert (outwards[sides & (corner[:, :, 2].max(axis=1) < 2.01)] > 0).all()
    np.testing.assert_array_equal(turned["corner_rgb"][:, ::-1], plain["corner_rgb"])
    np.testing.assert_array_equal(turned["corner_uv"][:, ::-1], plain["corner_uv"])


@pytest.mark.parametrize("ending", ["blend", "glb"])
def test_the_liveliest_clip_comes_along(files, ending):
    """Weights and matrices give what Blender's own modifier gives, frame by frame."""
    arrays = import_rigged(files / f"figure.{ending}").arrays
    assert str(arrays["anim_name"]) == "Bow"
    body = np.flatnonzero(arrays["part_id"] == np.argmax(np.bincount(arrays["part_id"])))
    weights = np.zeros((len(arrays["verts"]), 2))
    weights[arrays["w_row"], arrays["w_col"]] = arrays["w_val"]
    homogeneous = np.append(arrays["verts"], np.ones((len(weights), 1)), axis=1)
    obj = max((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: len(o.data.vertices))
    first, last = bpy.data.actions["Bow"].frame_range
    for k in (0, 11, 23):
        frame = first + (last - first) * k / 23
        bpy.context.scene.frame_set(int(frame), subframe=frame % 1)
        evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
        points = np.array([evaluated.matrix_world @ v.co for v in evaluated.data.vertices])
        moved = np.einsum("vb,bij,vj->vi", weights, arrays["anim_mats"][k], homogeneous)[body, :3]
        np.testing.assert_allclose(moved, points, atol=1e-4)
    assert np.abs(moved - arrays["verts"][body]).max() > 0.5


def test_nothing_in_a_file_is_run(files, tmp_path):
    """Neither a registered text nor the Python of a driver, also where Blender would run them by itself."""
    mark = tmp_path / "ran"
    bpy.ops.wm.open_mainfile(filepath=str(files / "figure.blend"))
    text = bpy.data.texts.new("evil.py")
    text.write(f"open({str(mark)!r}, 'w').write('text')")
    text.use_module = True
    driver = bpy.data.objects["Body"].driver_add("location", 0).driver
    driver.expression = f"open({str(mark)!r}, 'w').write('driver') and 0"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "evil.blend"), check_existing=False)
    mark.unlink(missing_ok=True)
    preferences = bpy.context.preferences.filepaths
    before, preferences.use_scripts_auto_execute = preferences.use_scripts_auto_execute, True
    try:
        asset = import_rigged(tmp_path / "evil.blend")
    finally:
        preferences.use_scripts_auto_execute = before
    assert len(asset.arrays["verts"]) == 15
    assert not mark.exists()


def test_what_has_no_rig_is_refused_by_name(files, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(files / "figure.blend"))
    for name, words in (("Body", "an armature but no mesh that follows it"), ("Rig", "no armature")):
        for obj in [o for o in bpy.data.objects if o.name in (name, "Hat")]:
            bpy.data.objects.remove(obj)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "less.blend"), check_existing=False, copy=True)
        with pytest.raises(InputError, match=f"less.blend' has {words}"):
            import_rigged(tmp_path / "less.blend")
    (tmp_path / "bad.vrm").write_bytes(b"glTF but not really")
    with pytest.raises(InputError, match=r"bad.vrm' cannot be imported"):
        import_rigged(tmp_path / "bad.vrm")
    with pytest.raises(InputError, match=r"is no rigged model; give a \.glb"):
        import_rigged(tmp_path / "figure.obj")


@pytest.mark.parametrize("name", ["od_Knight", "qb_Zombie", "oc_Fish", "q_animals_Alpaca"])
def test_models_are_what_the_catalogue_has_of_them(name):
    file, npz = ASSETS / f"rigged/{name}.glb", ASSETS / f"npz/{name}.npz"
    if not (file.is_file() and npz.is_file()):
        pytest.skip("needs the assets")
    found, known = import_rigged(file).arrays, np.load(npz)
    np.testing.assert_allclose(found["verts"], known["verts"], atol=1e-4)
    np.testing.assert_array_equal(found["faces"], known["faces"])

    def dense(arrays):
        weights = np.zeros((len(arrays["verts"]), len(arrays["bone_parent"])), np.float32)
        weights[arrays["w_row"], arrays["w_col"]] = arrays["w_val"]
        return weights[:, np.argsort(arrays["bone_names"])]

    assert sorted(found["bone_names"]) == sorted(known["bone_names"])
    np.testing.assert_allclose(dense(found), dense(known), atol=1e-3)
    order, wanted = np.argsort(found["bone_names"]), np.argsort(known["bone_names"])
    np.testing.assert_allclose(found["bone_head"][order], known["bone_head"][wanted], atol=1e-4)
    np.testing.assert_array_equal(found["bone_used"][order], known["bone_used"][wanted])
    assert np.abs(found["corner_rgb"].astype(int) - known["corner_rgb"]).mean() < 8


def test_the_command_imports_lists_failures_and_goes_on(files, tmp_path):
    broken = tmp_path / "models/broken.glb"
    broken.parent.mkdir()
    broken.write_bytes(b"glTF but not really")
    out = tmp_path / "out"

    def call(*more):
        command = [sys.executable, str(PROGRAM), "train-guidance", "import", *map(str, more), "--out", str(out)]
        command += ["--licence", "CC0", "--author", "A. Tester", "--progress", "none"]
        return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)

    done = call(files / "figure.glb", broken.parent)
    assert done.returncode == 0, done.stderr
    assert "'broken.glb' was not imported: " in done.stderr
    assert "has 1 of 2 models; 1 could not be imported" in done.stderr
    table = json.loads((out / "catalog.json").read_text())
    (entry,), (failure,) = table["assets"], table["failed"]
    assert (entry["name"], entry["license"], entry["author"], entry["n_bones"]) == ("figure", "CC0", "A. Tester", 2)
    assert entry["color_source"] == "texture"
    assert "broken.glb' cannot be imported" in failure["reason"]
    (asset,) = list_assets(out)  # as `pairs` and `train-prior` read them
    splats = load_asset(asset.path, 500)
    assert splats.clip.shape == (24, 2, 4, 4)
    assert splats.cloud.base_colors().std(axis=0).min() > 0.05
    before = (out / "npz/figure.npz").stat().st_mtime_ns
    again = call(files / "figure.glb")
    assert again.returncode == 0
    assert (out / "npz/figure.npz").stat().st_mtime_ns == before
    only = call(broken)
    assert only.returncode == 2
    assert "None of the 1 files could be imported" in only.stderr
