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


@pytest.mark.parametrize("switch", ["show_viewport", "show_render"])
def test_a_modifier_that_is_switched_off_is_switched_on(switch, tmp_path, capfd):
    def change(splats, armature):
        setattr(splats.modifiers["Armature"], switch, False)

    means = posed_in(tmp_path, "blend", change, *fig.TURN)
    assert "Modifier 'Armature' of 'fig' was switched off; it is on now." in capfd.readouterr().err
    np.testing.assert_allclose(means, fig.expected(fig.cloud().means), atol=1e-4)


@pytest.mark.parametrize("scale", [(1, 2, 1), (-1, 1, 1)])
def test_a_blend_of_stretched_splats_is_warned_of(scale, tmp_path, capfd):
    def change(splats, armature):
        armature.scale = scale

    posed_in(tmp_path, "blend", change, *fig.TURN)
    assert "Warning: Blender moves the splats, and turns and sizes them wrongly: 'fig' is" in capfd.readouterr().err


@pytest.mark.parametrize("what", ["target", "armature"])
@pytest.mark.parametrize("kind", ["ply", "glb", "blend"])
def test_what_is_linked_from_a_missing_file_is_refused(what, kind, tmp_path, capfd):
    """Blender has an empty object at the origin in its place, to which IK would reach."""
    library = tmp_path / "library.blend"
    if what == "armature":
        fig.empty()
        fig.add_rig()
        fig.save(library)
        fig.empty()
        fig.add_splats(linked(library, "Rig"))
        fig.save(tmp_path / "in.blend")
    else:
        fig.empty()
        fig.add_empty("Target", (0.6, 0, 1.3))
        fig.save(library)

        def reach(splats, armature):
            constraint = armature.pose.bones["hand.L"].constraints.new("IK")
            constraint.target, constraint.chain_count = linked(library, "Target"), 2

        fig.rigged(tmp_path / "in.blend", reach)
    library.unlink()
    name = "Rig" if what == "armature" else "Target"
    turn = ("--rotate", "head", "0", "20", "0")
    assert fig.run("pose", tmp_path / "in.blend", "--out", tmp_path / f"out.{kind}", *turn) == 2
    said = capfd.readouterr().err
    assert f"'{name}' is linked from '" in said
    assert "library.blend', which is missing; put that file back." in said
    assert not (tmp_path / f"out.{kind}").exists()


def linked(library, name: str):
    with bpy.data.libraries.load(str(library), link=True) as (_, found):
        found.objects = [name]
    bpy.context.scene.collection.objects.link(found.objects[0])
    return found.objects[0]


def test_no_driver_and_no_text_of_a_file_runs(tmp_path, capfd):
    mark = tmp_path / "ran"

    def change(splats, armature):
        curve = armature.pose.bones["head"].driver_add("rotation_quaternion", 1)
        curve.driver.expression = f"open({str(mark)!r}, 'w') and 0.5"
        text = bpy.data.texts.new("run.py")
        text.write(f"open({str(mark)!r}, 'w')")
        text.use_module = True

    posed_in(tmp_path, "ply", change, *fig.TURN)
    assert not mark.exists()
    assert "needs Python, which no file may run here; its value stays as it is" in capfd.readouterr().err


def test_names_of_files_may_be_anything_a_system_takes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fig.rigged(tmp_path / "-in ü'.blend")
    assert fig.run("pose", "--out=-out  ü.ply", "--", "-in ü'.blend") == 0
    np.testing.assert_allclose(read_ply(tmp_path / "-out  ü.ply").cloud.means, fig.cloud().means, atol=1e-5)


def test_frames_may_be_negative_and_lie_between_two(tmp_path):
    def change(splats, armature):
        quats = {-20: (1, 0, 0, 0), -10: (0.8, 0.6, 0, 0)}
        fig.key(armature, "rotation_quaternion", quats, armature.pose.bones["arm.L"], "Early")

    low, middle, high = (posed_in(tmp_path, "ply", change, "--frame", frame) for frame in (-15, -14.5, -14))
    wanted = posed_in(tmp_path, "blend", change, "--frame", -14.5)
    np.testing.assert_allclose(middle, wanted, atol=1e-5)
    away = np.linalg.norm(low - high, axis=1)
    assert away.max() > 0.03
    assert (np.linalg.norm(middle - low, axis=1) < 0.6 * away + 1e-6).all()
    assert (np.linalg.norm(middle - high, axis=1) < 0.6 * away + 1e-6).all()


def test_splats_of_another_scene_are_not_said_to_be_missing(tmp_path, capfd):
    def change(splats, armature):
        bpy.context.window.scene = bpy.data.scenes.new("Empty")

    source = fig.rigged(tmp_path / "in.blend", change)
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", *fig.TURN) == 2
    assert "has splats, 'fig', in its scene 'Scene' and was saved in 'Empty'" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--frame", "nan"), "nan is not in -1048574..1048574"),
        (("--frame", "1e12"), "1e12 is not in"),
        (("--rotate", "arm.L", "0", "inf", "0"), "the angles must be three numbers in degrees"),
        (("--set", "arm.L", "p", "nan"), "the value must be a number"),
    ],
)
def test_numbers_that_are_none_are_refused(arguments, words, tmp_path, capfd):
    assert fig.run("pose", fig.rigged(tmp_path / "in.blend"), "--out", tmp_path / "out.ply", *arguments) == 2
    assert words in capfd.readouterr().err


def test_a_modifier_that_makes_points_is_refused_with_the_splats_name(tmp_path, capfd):
    def change(splats, armature):
        splats.modifiers.new("Mirror", "MIRROR")
        splats.modifiers.move(len(splats.modifiers) - 1, 0)

    source = fig.rigged(tmp_path / "in.blend", change)
    assert fig.run("pose", source, "--out", tmp_path / "out.ply", *fig.TURN) == 2
    assert "'fig' has 120 splats, and its modifiers make 239 points of them" in capfd.readouterr().err
