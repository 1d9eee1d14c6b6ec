# SPDX-License-Identifier: GPL-3.0-or-later
"""The exported .glb, parsed by hand: splats, skin, animation, and the posed result against Blender's."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import splat_clouds as clouds
from glb import Glb, decode_attributes
from npm import npm_folder

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.rig.lbs import top_influences
from gskin_addon.core.rig.quaternion import matrix_to_quat, quat_multiply, quat_to_matrix
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.gltf import fallback_color
from gskin_addon.scene import gltf_export
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.gltf_export import SplatExport, export_glb
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import read_weights, write_weights

COUNT = 400
BONES = {
    "hips": (None, (0, 0, 0), (0, 0.1, 1)),
    "spine": ("hips", (0, 0.1, 1), (0, 0, 2)),
    "arm.L": ("spine", (0.2, 0, 1.8), (1.2, 0.1, 1.7)),
    "hand.L": ("arm.L", (1.2, 0.1, 1.7), (1.6, 0.2, 1.6)),
    "arm.R": ("spine", (-0.2, 0, 1.8), (-1.2, 0.1, 1.7)),
}
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Blender's axes to glTF's: (x, y, z) -> (x, z, -y)."""


def make_armature():
    data = bpy.data.armatures.new("Rig")
    armature = bpy.data.objects.new("Rig", data)
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (parent, head, tail) in BONES.items():
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = head, tail
        bone.parent = data.edit_bones[parent] if parent else None
    control = data.edit_bones.new("control")
    control.head, control.tail, control.use_deform = (0, 1, 0), (0, 1, 1), False
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.location, armature.scale, armature.rotation_euler = (
        (0.3, -0.2, 0.1),
        (1.5, 1.5, 1.5),
        (0.1, 0.2, 0.7),
    )
    return armature


def animate(armature):
    for name, quat in (
        ("spine", (0.9, 0.3, 0.1, 0.2)),
        ("arm.L", (0.6, 0.1, 0.7, 0.2)),
        ("hand.L", (0.1, 0.9, 0, 0)),
    ):
        bone = armature.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.keyframe_insert("rotation_quaternion", frame=1)
        bone.rotation_quaternion = quat
        bone.keyframe_insert("rotation_quaternion", frame=12)
    armature.animation_data.action.name = "Wave"


@pytest.fixture
def scene():
    """(splat object, armature, weights (N, B) in the order of BONES), both moved, turned and scaled."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = make_armature()
    obj = create_splat_object(clouds.random_cloud(COUNT, 3), "Splats")
    obj.location, obj.scale, obj.rotation_euler = (-0.4, 0.2, 0.9), (0.7, 0.7, 0.7), (0.4, -0.3, 1.1)
    bpy.context.view_layer.update()
    weights = np.random.default_rng(3).dirichlet(np.full(len(BONES), 0.4), COUNT).astype(np.float32)
    weights[weights < 1e-3] = 0.0  # Blender's exporter leaves out weights up to 1e-4
    write_weights(obj, armature, weights, list(BONES))
    animate(armature)
    bpy.context.scene.frame_set(1)
    bpy.context.view_layer.update()
    return obj, armature, weights


@pytest.fixture
def exported(scene, tmp_path):
    export_glb(tmp_path / "out.glb", [scene[0]])
    return Glb(tmp_path / "out.glb")


def assert_clouds_equal(cloud, expected):
    np.testing.assert_allclose(cloud.means, expected.means, atol=2e-6)
    np.testing.assert_allclose(np.abs(np.sum(cloud.quats * expected.quats, axis=1)), 1.0, atol=1e-6)
    np.testing.assert_allclose(cloud.scales, expected.scales, rtol=1e-6)
    np.testing.assert_array_equal(cloud.opacities, expected.opacities)
    np.testing.assert_allclose(cloud.sh, expected.sh, atol=2e-6)


def test_splats_are_stored_in_gltf_world_axes(scene, exported):
    node = exported.node("Splats")
    attributes = exported.attributes(node)
    expected = rotate_cloud(read_cloud(scene[0]), Y_UP)
    assert_clouds_equal(decode_attributes(attributes["POSITION"], attributes), expected)
    assert exported.primitive(node)["mode"] == 0
    assert exported.primitive(node)["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    assert exported.json["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in exported.json
    assert exported.primitive(node)["extras"]["GSKIN_splat_skinning"]["rotation"] == "weightedQuaternionSum"
    np.testing.assert_allclose(attributes["COLOR_0"] * 65535.0, fallback_color(expected), atol=1.01)


def test_only_known_attributes(exported):
    names = set(exported.attributes(exported.node("Splats")))
    harmonics = {f"KHR_gaussian_splatting:SH_DEGREE_{b}_COEF_{n}" for b in range(4) for n in range(2 * b + 1)}
    rest = {f"KHR_gaussian_splatting:{name}" for name in ("ROTATION", "SCALE", "OPACITY")}
    assert names == {"POSITION", "COLOR_0", "JOINTS_0", "WEIGHTS_0"} | harmonics | rest


def test_weights_by_joint_name(scene, exported):
    node = exported.node("Splats")
    attributes = exported.attributes(node)
    joint_names = [exported.json["nodes"][joint]["name"] for joint in exported.joints(node)]
    assert set(joint_names) == {*BONES, "control"}
    dense = np.zeros((COUNT, len(joint_names)))
    np.add.at(dense, (np.arange(COUNT)[:, None], attributes["JOINTS_0"]), attributes["WEIGHTS_0"])
    index, weight = top_influences(scene[2], 4)
    expected = np.zeros_like(scene[2])
    np.put_along_axis(expected, index, weight, axis=1)
    for column, name in enumerate(BONES):
        np.testing.assert_allclose(
            dense[:, joint_names.index(name)], expected[:, column], atol=1e-6, err_msg=name
        )


def test_inverse_bind_matrices(scene, exported):
    _, armature, _ = scene
    node = exported.node("Splats")
    turn = np.eye(4)
    turn[:3, :3] = Y_UP
    for joint, matrix in zip(exported.joints(node), exported.inverse_bind(node), strict=True):
        bone = armature.data.bones[exported.json["nodes"][joint]["name"]]
        rest = turn @ np.array(armature.matrix_world) @ np.array(bone.matrix_local)
        np.testing.assert_allclose(matrix @ rest, np.eye(4), atol=1e-5)


def test_our_import_reads_the_rigged_file_back(scene, tmp_path):
    """Splats with all that they have, weights as vertex groups, the armature and its action."""
    obj, _, weights = scene
    export_glb(tmp_path / "out.glb", [obj])
    before, bones = read_cloud(obj), list(BONES)
    bpy.context.scene.frame_set(5)
    posed = posed_cloud(obj)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    try:
        assert bpy.ops.gskin.import_splats(filepath=str(tmp_path / "out.glb"), place=True) == {"FINISHED"}
        back = bpy.context.object
        assert_clouds_equal(read_cloud(back), before)
        assert armature_of(back).name == "Rig"
        found, _ = read_weights(back, bones)
        index, weight = top_influences(weights, 4)
        expected = np.zeros_like(weights)
        np.put_along_axis(expected, index, weight, axis=1)
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert [other for other in bpy.data.objects if len(getattr(other.data, "vertices", ())) == COUNT] == [back]
        assert "Wave" in bpy.data.actions[0].name
        bpy.context.scene.frame_set(4)  # a clip begins at 0, its frame 1
        np.testing.assert_allclose(posed_cloud(back).means, posed.means, atol=2e-4)
    finally:
        gskin_addon.unregister()


def test_who_ignores_skins_finds_the_splats_where_they_are(scene, exported):
    """Engines without skinned splats apply the node's own transform to POSITION: it must be none."""
    splats, rig = exported.node("Splats"), exported.node("Rig")
    assert splats in exported.json["scenes"][0]["nodes"]
    assert splats not in exported.json["nodes"][rig].get("children", ())
    np.testing.assert_array_equal(exported.world()[splats], np.eye(4))
    assert exported.json["skins"][exported.json["nodes"][splats]["skin"]]["skeleton"] == rig
    world = exported.world(0.0)[rig]
    np.testing.assert_allclose(world[:3, 3], Y_UP @ scene[1].location, atol=1e-6)  # the armature stays where it is


def test_clips_begin_at_zero(scene, tmp_path):
    """Blender's frame 1 is 1/24 s: a still frame in every loop."""
    _, armature, _ = scene
    action = armature.animation_data.action
    for curve in pose_curves(action):
        for point in curve.keyframe_points:
            point.co_ui.x += 30
    export_glb(tmp_path / "out.glb", [scene[0]])
    exported = Glb(tmp_path / "out.glb")
    for animation in exported.json["animations"]:
        times = [exported.accessor(sampler["input"]) for sampler in animation["samplers"]]
        assert min(time[0] for time in times) == 0.0
        assert max(time[-1] for time in times) == pytest.approx(11 / 24)


def pose_curves(action):
    if hasattr(action, "layers") and len(action.layers):
        return [curve for bag in action.layers[0].strips[0].channelbags for curve in bag.fcurves]
    return list(action.fcurves)


def test_action_is_there(exported):
    (animation,) = exported.json["animations"]
    assert animation["name"] == "Wave"
    turned = {
        exported.json["nodes"][channel["target"]["node"]]["name"]
        for channel in animation["channels"]
        if channel["target"]["path"] == "rotation"
        and len(exported.accessor(animation["samplers"][channel["sampler"]]["input"])) > 2
    }
    assert turned == {"spine", "arm.L", "hand.L"}


@pytest.mark.parametrize("frame", [1, 5, 12])
def test_posed_splats_match_blender(scene, exported, frame):
    """Skinning by glTF's rules and docs/gltf.md's convention gives Blender's positions and rotations."""
    obj, _, _ = scene
    find_display(obj).show_viewport = False
    bpy.context.scene.frame_set(frame)
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    world = np.array(obj.matrix_world)
    positions = read_positions(evaluated.data) @ world[:3, :3].T + world[:3, 3]
    object_turn = matrix_to_quat(world[:3, :3] / np.cbrt(np.linalg.det(world[:3, :3])))
    rotations = quat_multiply(object_turn, read_attribute(evaluated.data, "rotation").astype(np.float64))

    node = exported.node("Splats")
    attributes = exported.attributes(node)
    matrices = exported.joint_matrices(node, (frame - 1) / bpy.context.scene.render.fps)  # a clip begins at 0
    joints, weights = attributes["JOINTS_0"].astype(int), attributes["WEIGHTS_0"].astype(np.float64)
    homogeneous = np.concatenate([attributes["POSITION"], np.ones((COUNT, 1))], axis=1)
    skinned = np.einsum("nk,nkij,nj->ni", weights, matrices[joints], homogeneous)[:, :3]
    np.testing.assert_allclose(skinned, positions @ Y_UP.T, atol=1e-5 * np.ptp(positions))

    linear = matrices[:, :3, :3] / np.cbrt(np.linalg.det(matrices[:, :3, :3]))[:, None, None]
    turns = matrix_to_quat(linear)[joints]
    strongest = turns[np.arange(COUNT), weights.argmax(axis=1)]
    signs = np.where(np.einsum("nki,ni->nk", turns, strongest) < 0.0, -1.0, 1.0)
    blended = np.einsum("nk,nki->ni", weights * signs, turns)
    blended /= np.linalg.norm(blended, axis=1, keepdims=True)
    turned = quat_multiply(blended, np.roll(attributes["KHR_gaussian_splatting:ROTATION"], 1, axis=1))
    expected = Y_UP @ quat_to_matrix(rotations)
    np.testing.assert_allclose(quat_to_matrix(turned), expected, atol=1e-4)
    if frame > 1:
        assert np.abs(skinned - attributes["POSITION"]).max() > 0.1


def test_rest_is_exported_whatever_the_pose(scene, tmp_path):
    obj, armature, _ = scene
    expected = rotate_cloud(read_cloud(obj), Y_UP)
    bpy.context.scene.frame_set(12)
    export_glb(tmp_path / "out.glb", [obj, armature])
    attributes = Glb(tmp_path / "out.glb")
    attributes = attributes.attributes(attributes.node("Splats"))
    assert_clouds_equal(decode_attributes(attributes["POSITION"], attributes), expected)
    assert bpy.context.scene.frame_current == 12


@pytest.mark.parametrize(
    "options", [{}, {"export_apply": True}, {"export_yup": False}, {"export_gn_mesh": True}]
)
def test_blenders_own_menu_with_any_options(scene, tmp_path, options):
    """File > Export > glTF writes splats, exports other objects as the options say, and changes nothing."""
    obj, _, _ = scene
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    cube.data.vertices.add(3)
    modifiers = [(modifier.name, modifier.show_viewport) for modifier in obj.modifiers]
    with gltf_export._discoverable():
        bpy.ops.export_scene.gltf(filepath=str(tmp_path / "out.glb"), **options)
    exported = Glb(tmp_path / "out.glb")
    node = exported.node("Splats")
    attributes = exported.attributes(node)
    expected = read_cloud(obj)
    if options.get("export_yup", True):
        expected = rotate_cloud(expected, Y_UP)
    assert_clouds_equal(decode_attributes(attributes["POSITION"], attributes), expected)
    assert "WEIGHTS_0" in attributes
    assert len(exported.joints(node)) == len(BONES) + 1
    assert exported.primitive(exported.node("Cube")).get("mode", 4) == 4
    assert {n["name"] for n in exported.json["nodes"]} == {*BONES, "control", "Rig", "Splats", "Cube"}
    assert [(modifier.name, modifier.show_viewport) for modifier in obj.modifiers] == modifiers


def test_splats_without_an_armature(tmp_path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    cloud = clouds.random_cloud(50, 1)
    obj = create_splat_object(cloud, "Free")
    obj.location = (1, 2, 3)
    export_glb(tmp_path / "out.glb", [obj])
    exported = Glb(tmp_path / "out.glb")
    node = exported.node("Free")
    attributes = exported.attributes(node)
    assert_clouds_equal(decode_attributes(attributes["POSITION"], attributes), rotate_cloud(cloud, Y_UP))
    np.testing.assert_allclose(exported.world()[node][:3, 3], [1, 3, -2])
    assert "JOINTS_0" not in attributes
    assert "extras" not in exported.primitive(node)


def test_deform_bones_only(scene, tmp_path):
    export_glb(tmp_path / "out.glb", [scene[0]], deform_bones_only=True, animations=False)
    exported = Glb(tmp_path / "out.glb")
    assert {
        exported.json["nodes"][joint]["name"] for joint in exported.joints(exported.node("Splats"))
    } == set(BONES)
    assert "animations" not in exported.json


def test_the_exporter_finds_the_class_in_the_add_on():
    assert gskin_addon.glTF2ExportUserExtension is SplatExport
    with pytest.raises(AttributeError, match="nothing_here"):
        _ = gskin_addon.nothing_here


def test_errors_leave_the_old_file_and_the_scene(scene, tmp_path):
    obj, armature, _ = scene
    path = tmp_path / "out.glb"
    path.write_bytes(b"old")
    obj.scale = (1.0, 2.0, 1.0)
    bpy.context.view_layer.update()
    with pytest.raises(InputError, match="scaled unevenly"):
        export_glb(path, [obj])
    obj.scale = (1.0, 1.0, 1.0)
    with pytest.raises(InputError, match="no splats among"):
        export_glb(path, [armature])
    with pytest.raises(InputError, match=r"does not end in \.glb"):
        export_glb(tmp_path / "out.gltf", [obj])
    with pytest.raises(InputError, match="is no folder"):
        export_glb(tmp_path / "none" / "out.glb", [obj])
    obj.data.vertices.add(2)
    obj.data.edges.add(1)
    obj.data.edges[0].vertices = (COUNT, COUNT + 1)
    with pytest.raises(InputError, match="faces or edges besides its splats"):
        export_glb(path, [obj])
    obj.hide_viewport = True
    with pytest.raises(InputError, match="'Splats' is hidden"):
        export_glb(path, [obj])
    assert path.read_bytes() == b"old"
    assert [item.name for item in tmp_path.iterdir()] == ["out.glb"]
    assert all(modifier.show_viewport for modifier in obj.modifiers)


def test_failing_exporter_is_one_sentence_and_changes_nothing(scene, tmp_path, monkeypatch):
    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    obj, _, _ = scene
    bpy.context.scene.frame_set(7)
    monkeypatch.setattr("io_scene_gltf2.blender.exp.export.__write_file", full)
    with pytest.raises(GSkinError) as caught:
        export_glb(tmp_path / "out.glb", [obj])
    assert str(caught.value).endswith("failed (OSError: [Errno 28] No space left on device).")
    assert not list(tmp_path.iterdir())
    assert bpy.context.scene.frame_current == 7
    assert all(modifier.show_viewport for modifier in obj.modifiers)
    assert not hasattr(sys.modules["io_scene_gltf2"], "glTF2ExportUserExtensions")


def test_khronos_validator(scene, tmp_path):
    folder = npm_folder("gltf-validator", "gltf-validator@2.0.0-dev.3.10")
    export_glb(tmp_path / "out.glb", [scene[0]])
    script = (
        "const fs = require('fs'), v = require('gltf-validator');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 0})"
        ".then(r => console.log(JSON.stringify(r)));"
    )
    command = ["node", "-e", script, str(tmp_path / "out.glb")]
    report = json.loads(
        subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    )
    codes = {message["code"] for message in report["issues"]["messages"]}
    assert codes <= {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}
    assert report["info"]["hasSkins"]
    assert report["info"]["totalVertexCount"] == COUNT


@pytest.mark.skipif(not clouds.ASSETS.is_dir(), reason="no shared assets")
def test_up_minus_y_brings_a_real_file_to_its_rig():
    """pc_biker_rig.json is in the PLY's axes, pc_biker_rig.glb opens in Blender's."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    folder = clouds.ASSETS / "splats"
    bpy.ops.import_scene.gltf(filepath=str(folder / "pc_biker_rig.glb"))
    armature = next(obj for obj in bpy.data.objects if obj.type == "ARMATURE")
    bones = json.loads((folder / "pc_biker_rig.json").read_text())["bones"]
    assert len(armature.data.bones) == len(bones)
    for name, bone in bones.items():
        head = armature.matrix_world @ armature.data.bones[name].head_local
        assert math.dist(head, up_rotation("-y") @ bone["head"]) < 1e-4


class CountedObjects(list):
    """A scene's objects that count how often they are looked through, by name or one by one."""

    walks = 0
    active = None

    def __iter__(self):
        CountedObjects.walks += 1
        return super().__iter__()

    def __contains__(self, wanted):
        CountedObjects.walks += 1
        return any(obj is wanted or obj.name == wanted for obj in list.__iter__(self))


class CountedObject:
    compared = 0

    def __init__(self, number):
        self.name, self.selected = f"o{number}", number % 2 == 0

    def select_get(self):
        return self.selected

    def select_set(self, selected):
        self.selected = selected

    def __eq__(self, other):
        CountedObject.compared += 1
        return self is other

    def __hash__(self):
        return hash(self.name)


def test_selecting_is_linear_in_the_objects(monkeypatch):
    objects = CountedObjects(CountedObject(number) for number in range(1000))
    layer = SimpleNamespace(objects=objects, update=lambda: None)
    monkeypatch.setattr(gltf_export, "bpy", SimpleNamespace(context=SimpleNamespace(view_layer=layer)))
    chosen = [obj for number, obj in enumerate(list.__iter__(objects)) if number % 3 == 0]
    with gltf_export._selected(chosen):
        assert [obj for obj in list.__iter__(objects) if obj.selected] == chosen
    assert [obj.selected for obj in list.__iter__(objects)] == [number % 2 == 0 for number in range(1000)]
    assert CountedObjects.walks <= 5
    assert CountedObject.compared <= len(objects)
