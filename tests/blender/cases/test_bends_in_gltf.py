# SPDX-License-Identifier: GPL-3.0-or-later
"""Bendy bones in glTF are joints: posed as glTF says, splats lie where Blender's modifier puts them."""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pytest
from bent_rig import bend, bent_rig, bind, segments
from glb import Glb

from gskin_addon.core.errors import GSkinError
from gskin_addon.scene import gltf_bends
from gskin_addon.scene.fabric import Fabric, lay_under
from gskin_addon.scene.gltf_export import export_glb
from gskin_addon.scene.import_file import ImportOptions, import_steps
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.steps import run_to_end

SAME = 1e-4
"""Of the size: Blender's exporter leaves out weights up to 0.0001."""


def curve(armature) -> None:
    """What bendy bones can do besides following their neighbours."""
    bone = armature.pose.bones["b1"]
    bone.bbone_curveinx, bone.bbone_curveoutz, bone.bbone_rollout = 0.1, -0.15, 0.6
    bone.bbone_easein, bone.bbone_scaleout = 1.6, (1.4, 1.3, 0.7)
    bone.scale = (1, 1.5, 0.8)
    armature.pose.bones["b2"].scale = (1.2, 0.7, 1)


def off(found: np.ndarray, obj) -> float:
    """Largest distance to what `gskin pose` writes, over the size."""
    wanted = posed_cloud(obj).means
    return float(np.abs(found - wanted).max() / np.ptp(wanted, axis=0).max())


def whole_file(obj, armature) -> list:
    groups = [[group.name for group in obj.vertex_groups], [bone.name for bone in armature.data.bones]]
    data = [obj.data, armature.data, obj.data.name, armature.data.name, len(bpy.data.meshes), len(bpy.data.armatures)]
    weights = [[(g.group, g.weight) for g in vertex.groups] for vertex in obj.data.vertices]
    return [groups, data, weights, [len(bone.constraints) for bone in armature.pose.bones]]


@pytest.mark.parametrize("deform_bones_only", [False, True])
def test_a_posed_file_has_what_bends(deform_bones_only, tmp_path):
    obj, armature = bent_rig()
    segments(armature, 5)
    bind(obj, armature, sharpness=15.0)
    bend(armature)
    curve(armature)
    armature.location, armature.rotation_euler, armature.scale = (1, 2, 3), (0.3, 0.4, 0.5), (1.5, 1.5, 1.5)
    bpy.context.view_layer.update()
    before = whole_file(obj, armature)
    out = tmp_path / "out.glb"
    (sentence,) = export_glb(out, [obj], posed=True, deform_bones_only=deform_bones_only)
    assert sentence.startswith("Segments of bendy bones are joints in 'out.glb', up to 6 for a splat (JOINTS_1)")
    assert whole_file(obj, armature) == before
    glb = Glb(out)
    assert off(glb.posed(glb.node("Splats")), obj) < SAME
    # One for the scale to take away and one more than segments, for each of two bones.
    assert len(glb.joints(glb.node("Splats"))) == 4 + 2 * 7


def test_a_fabric_under_the_splats_comes_back(tmp_path):
    """The exporter's own hooks must not bring it back before the splats' groups are what they were."""
    obj, armature = bent_rig()
    segments(armature, 3)
    bind(obj, armature)
    lay_under(obj, Fabric.of(np.array([[0, 1, 2], [1, 2, 3]], np.int32)))
    before, triangles = whole_file(obj, armature), len(obj.data.polygons)
    export_glb(tmp_path / "out.glb", [obj], posed=True)
    assert whole_file(obj, armature) == before
    assert len(obj.data.polygons) == triangles == 2


def test_what_nodes_would_have_to_shear_stands_free_in_poses_and_clips(tmp_path):
    """Bones, one of them bendy, that do not inherit scale below a stretched one."""
    obj, armature = bent_rig()
    segments(armature, 4)
    armature.data.bones["b3"].inherit_scale, armature.data.bones["b2"].inherit_scale = "NONE", "ALIGNED"
    bind(obj, armature, sharpness=15.0)
    bend(armature)
    for frame, size in ((1, 1.0), (9, 1.8)):
        fig.key(armature, "scale", {frame: (0.8, size, 1.1)}, armature.pose.bones["b1"])
    for bone in armature.pose.bones:
        bone.keyframe_insert("rotation_quaternion", frame=1)
    scene = bpy.context.scene
    scene.frame_set(9)
    before = whole_file(obj, armature)
    sentences = export_glb(tmp_path / "out.glb", [obj], posed=True)
    assert not [sentence for sentence in sentences if "shear" in sentence]
    assert whole_file(obj, armature) == before
    glb = Glb(tmp_path / "out.glb")
    assert off(glb.posed(glb.node("Splats")), obj) < SAME
    for frame in (1, 5, 9):
        scene.frame_set(frame)
        assert off(glb.posed(glb.node("Splats"), (frame - 1) / scene.render.fps), obj) < SAME, frame


def test_clips_bend(tmp_path):
    obj, armature = bent_rig()
    segments(armature, 4)
    bind(obj, armature)
    for frame, angle in ((1, 0.0), (9, 1.0)):
        for bone in armature.pose.bones:
            bone.rotation_mode = "XYZ"
            fig.key(armature, "rotation_euler", {frame: (0.4 * angle, 0.2 * angle, -0.6 * angle)}, bone)
        fig.key(armature, "bbone_curveoutz", {frame: 0.2 * angle}, armature.pose.bones["b1"])
        fig.key(armature, "scale", {frame: (1, 1 + angle, 1)}, armature.pose.bones["b1"])
    export_glb(tmp_path / "out.glb", [obj])
    glb = Glb(tmp_path / "out.glb")
    scene = bpy.context.scene
    for frame in (1, 5, 9):
        scene.frame_set(frame)
        assert off(glb.posed(glb.node("Splats"), (frame - 1) / scene.render.fps), obj) < SAME, frame


def test_it_comes_back_with_all_its_joints(tmp_path):
    obj, armature = bent_rig()
    segments(armature, 5)
    bind(obj, armature, sharpness=15.0)
    bend(armature)
    export_glb(tmp_path / "out.glb", [obj], posed=True)
    means = posed_cloud(obj).means
    fig.empty()
    scene = bpy.context.scene
    steps = import_steps(tmp_path / "out.glb", ImportOptions(), None, scene, scene.collection)
    found = posed_cloud(run_to_end(steps).object).means
    assert np.abs(found - means).max() < 1e-3 * np.ptp(means, axis=0).max()


def test_bones_of_linked_data_bend_too(tmp_path):
    """The armature object is the file's own, its bones are a library's."""
    fig.empty()
    fig.add_rig().data.bones["arm.L"].bbone_segments = 5
    fig.save(tmp_path / "library.blend")
    fig.empty()
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, found):
        found.armatures = ["Rig"]
    armature = bpy.data.objects.new("Rig", found.armatures[0])
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.update()
    obj = fig.add_splats(armature)
    armature.pose.bones["hand.L"].rotation_quaternion = (0.8, 0.6, 0, 0)
    armature.pose.bones["arm.L"].rotation_quaternion = (0.8, 0, 0, 0.6)
    bpy.context.view_layer.update()
    assert export_glb(tmp_path / "out.glb", [obj], posed=True) == []
    glb = Glb(tmp_path / "out.glb")
    assert off(glb.posed(glb.node("fig")), obj) < SAME
    assert armature.data == found.armatures[0]


def test_a_rig_that_cannot_be_changed_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(gltf_bends, "can_be_joints", lambda armature: False)
    monkeypatch.setattr("gskin_addon.scene.gltf_export.can_be_joints", lambda armature: False)
    obj, armature = bent_rig()
    segments(armature, 3)
    bind(obj, armature)
    (sentence,) = export_glb(tmp_path / "out.glb", [obj])
    assert sentence.startswith("glTF has no bendy bones: 2 that move 'Splats' ('b1', 'b2') are without segments")


def test_a_failing_export_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    obj, armature = bent_rig()
    segments(armature, 3)
    bind(obj, armature)
    before = whole_file(obj, armature)

    def fail(*_):
        raise GSkinError("no")

    monkeypatch.setattr("gskin_addon.scene.gltf_export._add_splats", fail)
    with pytest.raises(GSkinError):
        export_glb(tmp_path / "out.glb", [obj])
    assert whole_file(obj, armature) == before
