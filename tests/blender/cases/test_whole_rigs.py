# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig comes with all that moves it, and stands in the output as it stands in its file."""

from __future__ import annotations

import functools
import sys

import bpy
import figure_rig as fig
import numpy as np
import pretend
import pytest
import worker_jobs as jobs
from glb import Glb

from gskin_addon.core.errors import InputError
from gskin_addon.core.worker.client import WorkerClient
from gskin_addon.scene import rig_files
from gskin_addon.scene.rig_fit import move_rig, scale_rig
from gskin_addon.session import skin_job
from gskin_addon.session.readiness import checks


@pytest.fixture
def rig(monkeypatch, tmp_path):
    """`gskin rig` with a worker that gives each splat to a bone by its height; OUT is the path that it wrote."""
    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    monkeypatch.setattr(skin_job, "WorkerClient", functools.partial(WorkerClient, program=jobs.FAKE))
    splats = fig.write_figure(tmp_path / "fig.ply")

    def run(armature, out, code=0):
        options = ("--armature", armature, "--out", tmp_path / out, "--progress", "none")
        assert fig.run("rig", splats, *options) == code
        return tmp_path / out

    return run


def tails() -> dict[str, tuple[float, ...]]:
    """Ends of the bones of 'Rig' in the world, evaluated."""
    bpy.context.view_layer.update()
    armature = next(obj for obj in bpy.context.scene.objects if obj.name == "Rig")
    evaluated = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {bone.name: tuple(evaluated.matrix_world @ bone.tail) for bone in evaluated.pose.bones}


def source(path, change):
    """A file with a rig, its cube, and what change(armature) adds; where its bones end."""
    fig.empty()
    armature = fig.add_rig()
    change(armature)
    cube = bpy.data.objects.new("body", bpy.data.meshes.new("body"))
    bpy.context.scene.collection.objects.link(cube)
    cube.parent = armature
    found = tails()
    fig.save(path)
    return path, found


def ik_with_pole(armature):
    constraint = armature.pose.bones["hand.L"].constraints.new("IK")
    constraint.target, constraint.chain_count = fig.add_empty("target", (0.6, 0, 1.25)), 2
    constraint.pole_target = fig.add_empty("pole", (0.3, -1.0, 1.6))


def driver_of_another(armature):
    panel = fig.add_empty("panel")
    panel["turn"] = 0.7
    bone = armature.pose.bones["arm.L"]
    bone.rotation_mode = "XYZ"
    curve = bone.driver_add("rotation_euler", 0)
    variable = curve.driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path = panel, '["turn"]'
    curve.driver.expression = variable.name


def driven_driver(armature):
    """The panel's property follows a third object."""
    driver_of_another(armature)
    third = fig.add_empty("third", (0.4, 0, 0))
    curve = bpy.data.objects["panel"].driver_add('["turn"]')
    variable = curve.driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id, variable.targets[0].transform_type = third, "LOC_X"
    curve.driver.expression = variable.name


def scene_driver(armature):
    """A property of the scene drives a bone."""
    bpy.context.scene["turn"] = 0.6
    bone = armature.pose.bones["arm.L"]
    bone.rotation_mode = "XYZ"
    curve = bone.driver_add("rotation_euler", 0)
    variable = curve.driver.variables.new()
    variable.targets[0].id_type = "SCENE"
    variable.targets[0].id, variable.targets[0].data_path = bpy.context.scene, '["turn"]'
    curve.driver.expression = variable.name


def data_driver(armature):
    """A property of the armature's own data drives a bone."""
    armature.data["turn"] = 0.6
    bone = armature.pose.bones["arm.L"]
    bone.rotation_mode = "XYZ"
    curve = bone.driver_add("rotation_euler", 0)
    variable = curve.driver.variables.new()
    variable.targets[0].id_type = "ARMATURE"
    variable.targets[0].id, variable.targets[0].data_path = armature.data, '["turn"]'
    curve.driver.expression = variable.name


def chain_of_armatures(armature):
    """Copy Transforms from a control rig, which itself has IK to an empty."""
    control = fig.add_rig("Control")
    constraint = control.pose.bones["hand.L"].constraints.new("IK")
    constraint.target, constraint.chain_count = fig.add_empty("target", (0.5, 0, 1.3)), 2
    constraint.pole_target = fig.add_empty("pole", (0.3, -1.0, 1.6))
    for name in ("arm.L", "hand.L"):
        copy = armature.pose.bones[name].constraints.new("COPY_TRANSFORMS")
        copy.target, copy.subtarget = control, name


def armature_constraint(armature):
    holder = fig.add_rig("Control")
    holder.pose.bones["arm.R"].rotation_quaternion = (0.9, 0.3, 0, 0.3)
    constraint = armature.pose.bones["arm.R"].constraints.new("ARMATURE")
    target = constraint.targets.new()
    target.target, target.subtarget = holder, "arm.R"


def spline_ik(armature):
    data = bpy.data.curves.new("path", "CURVE")
    data.dimensions = "3D"
    spline = data.splines.new("POLY")
    spline.points.add(2)
    for point, co in zip(spline.points, [(0.1, 0, 1), (0.4, 0, 1.2), (0.6, 0.1, 1.6)], strict=True):
        point.co = (*co, 1)
    path = bpy.data.objects.new("path", data)
    bpy.context.scene.collection.objects.link(path)
    hook = path.modifiers.new("hook", "HOOK")
    hook.object = fig.add_empty("hook", (0, 0, 0.2))
    hook.vertex_indices_set([2])
    constraint = armature.pose.bones["hand.L"].constraints.new("SPLINE_IK")
    constraint.target, constraint.chain_count = path, 2


def constrained_object(armature):
    follow = fig.add_empty("mover", (0.2, 0.1, 0.3))
    follow.parent = fig.add_empty("mover's parent", (0, 0, 0.5))
    constraint = armature.constraints.new("COPY_LOCATION")
    constraint.target = follow


def parented(armature):
    top = fig.add_empty("top", (0, 0, 0.2))
    middle = fig.add_empty("middle", (0.1, 0, 0))
    middle.parent, armature.parent = top, middle


def child_of_bone(armature):
    carrier = fig.add_rig("Carrier")
    carrier.pose.bones["spine"].rotation_quaternion = (0.98, 0, 0, 0.2)
    armature.parent, armature.parent_type, armature.parent_bone = carrier, "BONE", "spine"


def shrinkwrapped(armature):
    mesh = bpy.data.meshes.new("ground")
    mesh.from_pydata([(-2, -2, 1.2), (2, -2, 1.2), (0, 2, 1.2)], [], [(0, 1, 2)])
    ground = bpy.data.objects.new("ground", mesh)
    bpy.context.scene.collection.objects.link(ground)
    constraint = armature.pose.bones["arm.L"].constraints.new("SHRINKWRAP")
    constraint.target = ground


def animated_target(armature):
    ik_with_pole(armature)
    fig.key(bpy.data.objects["target"], "location", {1: (0.6, 0, 1.25), 20: (0.4, 0, 1.5)}, name="TargetMove")
    bpy.context.scene.frame_end = 20
    bpy.context.scene.frame_set(20)


def stretched_time(armature):
    """Frames of the scene are not those of its animation."""
    fig.wave(armature, "Wave")
    scene = bpy.context.scene
    scene.render.frame_map_old, scene.render.frame_map_new = 100, 200
    scene.frame_set(10)


def keyed_influence(armature):
    constraint = armature.pose.bones["hand.L"].constraints.new("IK")
    constraint.target, constraint.chain_count = fig.add_empty("target", (0.6, 0, 1.4)), 2
    fig.key(armature, "influence", {1: 0.0, 10: 1.0}, constraint)
    bpy.context.scene.frame_set(8)


WHOLE = [
    stretched_time, keyed_influence,
    ik_with_pole, driver_of_another, driven_driver, scene_driver, data_driver, chain_of_armatures, armature_constraint,
    spline_ik, constrained_object, parented, child_of_bone, shrinkwrapped, animated_target,
]  # fmt: skip


@pytest.mark.parametrize("change", WHOLE, ids=lambda f: f.__name__)
def test_bones_end_where_they_do_in_their_file(change, tmp_path):
    path, before = source(tmp_path / "rig.blend", change)
    fig.empty()
    armature = rig_files.import_armature(path, "Rig")
    assert armature.name == "Rig"
    for name, place in tails().items():
        np.testing.assert_allclose(place, before[name], atol=1e-5, err_msg=name)
    assert bpy.data.objects.get("body") is None
    rig_files.save_blend(tmp_path / "out.blend")
    rig_files.open_blend(tmp_path / "out.blend")
    for name, place in tails().items():
        np.testing.assert_allclose(place, before[name], atol=1e-5, err_msg=name)
    assert max(np.abs(np.subtract(before[name], tail)).max() for name, _, _, tail in fig.BONES) > 0.01
    # Artists can grasp all of it.
    assert {obj.name for obj in bpy.data.objects} == {obj.name for obj in bpy.context.scene.objects}


@pytest.mark.parametrize("change", [ik_with_pole, animated_target, chain_of_armatures], ids=lambda f: f.__name__)
def test_a_rig_is_moved_and_scaled_with_what_moves_it(change, tmp_path):
    path, before = source(tmp_path / "rig.blend", change)
    fig.empty()
    armature = rig_files.import_armature(path, "Rig")
    scale_rig(armature, 3.0)
    move_rig(armature, np.array([1.0, -2.0, 0.5]))
    bpy.context.scene.frame_set(bpy.context.scene.frame_current)
    for name, place in tails().items():
        np.testing.assert_allclose(place, 3 * np.array(before[name]) + [1, -2, 0.5], atol=1e-4, err_msg=name)


def test_what_is_kept_beside_the_rig_is_not_rendered(tmp_path):
    path, _ = source(tmp_path / "rig.blend", shrinkwrapped)
    fig.empty()
    rig_files.import_armature(path)
    ground = bpy.data.objects["ground"]
    assert ground.hide_render
    assert ground.display_type == "WIRE"


def test_shapes_of_bones_come_and_are_not_seen(tmp_path):
    def shaped(armature):
        shape = bpy.data.objects.new("WGT", bpy.data.meshes.new("WGT"))
        bpy.context.scene.collection.objects.link(shape)
        armature.pose.bones["head"].custom_shape = shape

    path, _ = source(tmp_path / "rig.blend", shaped)
    fig.empty()
    armature = rig_files.import_armature(path)
    assert armature.pose.bones["head"].custom_shape == bpy.data.objects["WGT"]
    assert [obj.name for obj in bpy.context.scene.objects] == ["Rig"]


def test_the_target_moves_the_splats_in_every_output(tmp_path, rig, capfd):
    path, _ = source(tmp_path / "rig.blend", animated_target)
    out = rig(path, "out.blend")
    first, last = (fig.posed_means(out, "--frame", frame) for frame in (1, 20))
    assert np.abs(first - last).max() < 1e-6  # the worker that pretends gives all to the spine
    fig.empty()
    rig_files.open_blend(out)
    ends = []
    for frame in (1, 20):
        bpy.context.scene.frame_set(frame)
        ends.append(tails()["hand.L"])
    glb = Glb(rig(path, "out.glb"))
    assert fig.turns_in_clip(glb, "arm.L") > 0.05
    assert np.linalg.norm(np.subtract(*ends)) > 0.1


def hidden(armature):
    armature.hide_viewport = armature.hide_select = True


def excluded(armature):
    fig.move_to_collection([armature])
    bpy.context.view_layer.layer_collection.children["Hidden"].exclude = True


@pytest.mark.parametrize("change", [hidden, excluded], ids=lambda f: f.__name__)
@pytest.mark.parametrize("out", ["out.blend", "out.glb"])
def test_hidden_rigs_work(change, out, tmp_path, rig):
    fig.empty()
    armature = fig.add_rig()
    change(armature)
    fig.save(tmp_path / "rig.blend")
    path = rig(tmp_path / "rig.blend", out)
    if out.endswith(".glb"):
        assert Glb(path).node("hand.L") >= 0


def linked(how):
    """A function that saves a file with a rig from a library, in a way of its own."""

    def make(folder):
        library = folder / "lib" / "char.blend"
        library.parent.mkdir()
        fig.empty()
        armature = fig.add_rig()
        ik_with_pole(armature)
        fig.move_to_collection(list(bpy.context.scene.objects), "Char")
        found = tails()
        fig.save(library)
        fig.empty()
        with bpy.data.libraries.load(str(library), link=True) as (_, target):
            target.collections = ["Char"]
        how(target.collections[0])
        fig.save(folder / "shot.blend")
        return folder / "shot.blend", found

    make.__name__ = how.__name__
    return make


def as_instance(collection):
    instance = fig.add_empty("Char instance")
    instance.instance_type, instance.instance_collection = "COLLECTION", collection


def as_links(collection):
    bpy.context.scene.collection.children.link(collection)


def as_override(collection):
    bpy.context.scene.collection.children.link(collection)
    bpy.context.view_layer.update()
    collection.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer, do_fully_editable=True)
    bpy.context.scene.collection.children.unlink(collection)


def as_override_of_one(collection):
    bpy.context.scene.collection.children.link(collection)
    next(obj for obj in collection.objects if obj.type == "ARMATURE").override_create(remap_local_usages=True)


LINKED = [linked(how) for how in (as_instance, as_links, as_override, as_override_of_one)]


@pytest.mark.parametrize("make", LINKED, ids=lambda f: f.__name__)
def test_linked_rigs_become_the_files_own(make, tmp_path):
    path, before = make(tmp_path)
    fig.empty()
    armature = rig_files.import_armature(path)
    assert armature.name == "Rig"
    rig_files.save_blend(tmp_path / "out.blend")
    rig_files.open_blend(tmp_path / "out.blend")
    assert not bpy.data.libraries
    assert sorted(obj.name for obj in bpy.context.scene.objects if obj.type == "ARMATURE") == ["Rig"]
    for name, place in tails().items():
        np.testing.assert_allclose(place, before[name], atol=1e-5, err_msg=name)


def test_an_instance_is_where_it_stands(tmp_path):
    path, before = linked(as_instance)(tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.data.objects["Char instance"].location = (1.0, 0.0, 2.0)
    fig.save(path)
    fig.empty()
    rig_files.import_armature(path)
    np.testing.assert_allclose(tails()["head"], np.add(before["head"], (1, 0, 2)), atol=1e-5)


def test_what_cannot_be_chosen_is_refused_before_the_job(tmp_path, rig, capfd):
    path, _ = linked(as_instance)(tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    twin = bpy.data.objects["Char instance"].copy()
    bpy.context.scene.collection.objects.link(twin)
    fig.save(path)
    rig(path, "out.blend", code=2)
    assert "in several instances, 'Char instance', 'Char instance.001'" in capfd.readouterr().err
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.data.objects.remove(bpy.data.objects["Char instance.001"])
    fig.save(path)
    (tmp_path / "lib" / "char.blend").unlink()
    rig(path, "out.blend", code=2)
    assert "is missing" in capfd.readouterr().err
    assert not (tmp_path / "out.blend").exists()


def test_python_in_drivers_is_not_run_and_said(tmp_path, capfd):
    def scripted(splats, armature):
        driver_of_another(armature)
        armature.animation_data.drivers[0].driver.expression = "sum([c for c in (turn, 1)]) if True else 0"

    path = fig.rigged(tmp_path / "in.blend", scripted)
    assert fig.run("pose", path, "--out", tmp_path / "out.ply", "--rotate", "head", 0, 20, 0) == 0
    assert "needs Python, which no file may run here" in capfd.readouterr().err


def test_an_instanced_rig_in_the_window(tmp_path, monkeypatch):
    path, _ = linked(as_instance)(tmp_path)
    with pretend.session(tmp_path, monkeypatch):
        bpy.ops.wm.open_mainfile(filepath=str(path))
        (check,) = (check for check in checks(bpy.context) if check.name == "Armature")
        assert check.sentence.startswith("Armature 'Rig' is only in the instance 'Char instance': Object > Library")


def test_no_armature_is_still_said(tmp_path):
    fig.empty()
    fig.add_empty("nothing")
    fig.save(tmp_path / "none.blend")
    with pytest.raises(InputError, match="has no armature"):
        rig_files.import_armature(tmp_path / "none.blend")
