# SPDX-License-Identifier: GPL-3.0-or-later
"""Further inputs of the kinds of issue 18: what is written is right, or it is said what is not, or refused."""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pytest
from glb import Glb

from gskin_addon.core.splats.ply import read_ply
from gskin_addon.scene.node_groups import find_display


def posed_by_blender(path) -> np.ndarray:
    """Centres (N, 3) in the world that the modifiers give in a .blend."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    obj = bpy.data.objects["fig"]
    find_display(obj).show_viewport = False
    bpy.context.view_layer.update()
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    points = np.array([vertex.co for vertex in mesh.vertices])
    matrix = np.array(obj.matrix_world)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def posed_in(tmp_path, kind: str, change, *arguments: object) -> np.ndarray:
    """Centres that `gskin pose` writes into a .ply, .glb or .blend."""
    source = fig.rigged(tmp_path / "in.blend", change)
    out = tmp_path / f"out.{kind}"
    assert fig.run("pose", source, "--out", out, *arguments) == 0
    if kind == "ply":
        return read_ply(out).cloud.means
    if kind == "glb":
        return Glb(out).posed(Glb(out).node("fig"))
    return posed_by_blender(out)


def scaled_parent(splats, armature):
    parent = fig.add_empty("Parent", (0.5, 0, 0))
    parent.scale = (2, 2, 2)
    armature.parent = parent
    bpy.context.view_layer.update()


def two_of_one_armature(splats, armature):
    twin = armature.copy()
    bpy.context.scene.collection.objects.link(twin)
    twin.location = (2, 0, 0)


def bones_that_do_not_inherit(splats, armature):
    armature.data.bones["arm.L"].inherit_scale = "NONE"
    armature.data.bones["hand.R"].use_local_location = False
    armature.pose.bones["hand.R"].location = (0.1, 0.05, 0)
    armature.pose.bones["spine"].scale = (1.5, 1.5, 1.5)


def pushing_nodes(splats, armature):
    group = bpy.data.node_groups.new("Push", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    source, sink = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    push = group.nodes.new("GeometryNodeSetPosition")
    push.inputs["Offset"].default_value = (0, 0, 0.5)
    group.links.new(source.outputs[0], push.inputs[0])
    group.links.new(push.outputs[0], sink.inputs[0])
    splats.modifiers.new("Push", "NODES").node_group = group
    splats.modifiers.move(len(splats.modifiers) - 1, 0)


def shape_key(splats, armature):
    splats.shape_key_add(name="Basis")
    raised = splats.shape_key_add(name="Raised")
    for point in raised.data:
        point.co.z += 0.3
    raised.value = 1.0


def in_edit_mode(name: str):
    def change(splats, armature):
        bpy.context.view_layer.objects.active = splats if name == "splats" else armature
        bpy.ops.object.mode_set(mode="EDIT")

    change.__name__ = f"{name}_in_edit_mode"
    return change


def bone_that_deforms_no_more(splats, armature):
    armature.data.bones["hand.L"].use_deform = False


RIGHT = [scaled_parent, two_of_one_armature, bones_that_do_not_inherit, pushing_nodes, shape_key]
RIGHT += [in_edit_mode("splats"), in_edit_mode("armature"), bone_that_deforms_no_more]


@pytest.mark.parametrize("change", RIGHT, ids=lambda change: change.__name__)
def test_posed_splats_lie_where_blender_puts_them(change, tmp_path, capfd):
    wanted = posed_in(tmp_path, "blend", change, *fig.TURN)
    np.testing.assert_allclose(posed_in(tmp_path, "ply", change, *fig.TURN), wanted, atol=1e-5)
    capfd.readouterr()
    in_glb = posed_in(tmp_path, "glb", change, *fig.TURN)
    said = capfd.readouterr().err
    if change is shape_key:
        assert "it does not show that shape keys move them" in said
    elif change is pushing_nodes:
        assert "it does not show that modifier 'Push' deforms them too" in said
    else:
        np.testing.assert_allclose(in_glb, wanted, atol=1e-4)
        assert "Warning" not in said


def test_what_gltf_cannot_shear_is_said(tmp_path, capfd, monkeypatch):
    """Of a rig to which no stand-ins can be added."""
    monkeypatch.setattr("gskin_addon.scene.gltf_bends.can_be_joints", lambda armature: False)
    monkeypatch.setattr("gskin_addon.scene.gltf_export.can_be_joints", lambda armature: False)

    def change(splats, armature):
        armature.data.bones["arm.L"].inherit_scale = "NONE"
        turned = {1: (0.9, 0.3, 0.1, 0)}
        fig.key(armature, "rotation_quaternion", turned, armature.pose.bones["arm.L"], "Stretch")
        fig.key(armature, "scale", {1: (1, 1, 1), 10: (1, 1.5, 0.8)}, armature.pose.bones["spine"])

    posed_in(tmp_path, "glb", change)
    said = capfd.readouterr().err
    assert "Warning: glTF nodes cannot be sheared: 'arm.L', 'hand.L' of 'Rig' do not stand in the file" in said


