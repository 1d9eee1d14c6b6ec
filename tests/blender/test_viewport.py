# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport's shader is given, and which objects are given to it. Pictures: tests/window/splats.py."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds
from patience import HANG

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.render.drawn_splats import largest
from gskin_addon.core.render.view_order import view_colors
from gskin_addon.core.rig.colors import weight_colors
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.core.splats.sh import eval_sh, rotate_sh
from gskin_addon.scene.display_inputs import BY_SHADER, NATIVE, OCTAHEDRA
from gskin_addon.scene.node_builder import get_input, has_input
from gskin_addon.scene.node_groups import (
    add_display,
    find_display,
    get_display,
    set_display,
)
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.splat_object import create_splat_object, replace_cloud
from gskin_addon.scene.transforms import world_similarity
from gskin_addon.scene.viewport import following, switch, visible
from gskin_addon.scene.viewport.reading import read_posed, read_rest
from gskin_addon.scene.viewport.sorter import Sorter
from gskin_addon.scene.weights import write_weights

EVERY = 1_000_000


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def window(monkeypatch):
    """The add-on as in a window, where the shader draws; there is none here."""
    gskin_addon.register()
    monkeypatch.setattr(switch, "wanted", lambda scene: not switch.failure and switch.setting(scene))
    yield
    switch.try_again()
    gskin_addon.unregister()


def splat_object(cloud, name: str):
    """Splats that Blender does not draw by itself."""
    obj = create_splat_object(cloud, name)
    if has_input(add_display(obj), NATIVE):
        set_display(obj, NATIVE, False)
    return obj


def evaluated(obj):
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get())


def read(obj, limit: int = EVERY):
    rest = read_rest(obj, limit)
    return read_posed(evaluated(obj), rest, limit)


def bound(degree: int = 2, count: int = 60):
    """Splats with harmonics on a crooked rig, both moved, in a pose."""
    rng = np.random.default_rng(3)
    cloud = clouds.random_cloud(count, degree)
    obj, armature = splat_object(cloud, "S"), rigs.make_chains(7, rng)
    write_weights(obj, armature, sparsify(rigs.random_weights(cloud, 7, rng), 4))
    rigs.place(obj, (1, 2, 3), (0.3, -0.2, 0.5), 1.7)
    rigs.random_pose(armature, rng)
    set_display(obj, BY_SHADER, True)
    return obj, armature


def test_the_mesh_has_points_and_one_edge_without_length():
    cloud = clouds.random_cloud(40, 3)
    obj = splat_object(cloud, "S")
    set_display(obj, BY_SHADER, True)
    mesh = evaluated(obj).data
    assert (len(mesh.vertices), len(mesh.edges), len(mesh.polygons)) == (42, 1, 0)
    first, second = (mesh.vertices[i].co for i in mesh.edges[0].vertices)
    assert first == second
    assert not [a.name for a in mesh.attributes if a.name.startswith("radiance:sh")]


def test_posed_splats_are_those_of_the_rigs_formulas():
    obj, _ = bound()
    got, wanted = read(obj), posed_cloud(obj)
    rotation, scale, translation = world_similarity(obj)
    points = got.points @ rotation.T * scale + translation
    size = np.linalg.norm(np.ptp(wanted.means, axis=0))
    assert np.abs(points - wanted.means).max() < 1e-5 * size
    mine = rotation @ quat_to_matrix(got.rotations)
    np.testing.assert_allclose(mine, quat_to_matrix(wanted.quats), atol=1e-4)
    np.testing.assert_allclose(got.scales * scale, wanted.scales, rtol=1e-4)
    np.testing.assert_allclose(got.opacities, wanted.opacities, atol=1e-6)


@pytest.mark.parametrize("parallel", [False, True], ids=["perspective", "orthographic"])
def test_posed_harmonics_look_as_if_they_were_turned(parallel):
    """The colours that a view sees, against coefficients turned by bones and object in numpy."""
    obj, _ = bound(degree=3)
    wanted, splats = posed_cloud(obj), read(obj)
    eye = np.array([2.0, -9.0, 4.0])
    direction = eye / np.linalg.norm(eye)
    rotation, scale, translation = world_similarity(obj)
    if parallel:
        rays = np.broadcast_to(-direction, wanted.means.shape)
        own = np.append(rotation.T @ direction, 0.0)
    else:
        rays = wanted.means - eye
        own = np.append(rotation.T @ (eye - translation) / scale, 1.0)
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    seen = eval_sh(wanted.sh, rays)
    np.testing.assert_allclose(view_colors(splats, own), seen, atol=2e-3)
    flat = eval_sh(rotate_sh(read_rest(obj, EVERY).sh, rotation), rays)
    assert np.abs(flat - seen).max() > 0.1, "the pose does not matter to these colours"


def test_limit_size_and_colours_are_the_displays():
    obj, _ = bound(degree=0)
    every, cloud = read(obj), posed_cloud(obj)
    some = read(obj, 20)
    np.testing.assert_array_equal(some.points, every.points[largest(cloud.scales, cloud.opacities, 20)])
    set_display(obj, "Size", 2.0)
    np.testing.assert_allclose(read(obj).scales, 2 * every.scales, rtol=1e-6)
    assert every.colors is None
    set_display(obj, "Show Bones", True)
    colors = read(obj).colors
    from gskin_addon.scene.weights import read_weights

    np.testing.assert_allclose(colors, weight_colors(read_weights(obj)[0]), atol=2e-3)
    assert len(read(obj, 20).colors) == 20
    set_display(obj, "Show Bones", False)
    assert read(obj).colors is None
    set_display(obj, "Show Weights Of", "bone.003")
    assert read(obj).colors is not None


def test_where_modifiers_leave_splats_out_the_others_are_drawn():
    obj, _ = bound()
    group = bpy.data.node_groups.new("Half", "GeometryNodeTree")
    for name, way in (("Geometry", "INPUT"), ("Geometry", "OUTPUT")):
        group.interface.new_socket(name, in_out=way, socket_type="NodeSocketGeometry")
    source, end = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    delete, index = group.nodes.new("GeometryNodeDeleteGeometry"), group.nodes.new("GeometryNodeInputIndex")
    less = group.nodes.new("FunctionNodeCompare")
    less.data_type, less.operation = "INT", "LESS_THAN"
    group.links.new(index.outputs[0], next(s for s in less.inputs if s.name == "A" and s.enabled))
    next(s for s in less.inputs if s.name == "B" and s.enabled).default_value = 25
    group.links.new(less.outputs[0], delete.inputs["Selection"])
    group.links.new(source.outputs[0], delete.inputs[0])
    group.links.new(delete.outputs[0], end.inputs[0])
    whole = read(obj)
    modifier = obj.modifiers.new("Half", "NODES")
    modifier.node_group = group
    obj.modifiers.move(len(obj.modifiers) - 1, len(obj.modifiers) - 2)
    got = read(obj)
    np.testing.assert_allclose(got.points, whole.points[25:], atol=1e-6)
    assert got.sh.shape[1] == 1
    np.testing.assert_allclose(got.sh[:, 0], whole.sh[25:, 0], atol=1e-6)
    assert read(obj, 10).count == 10


def test_ellipsoids_are_no_points_for_the_shader():
    obj = splat_object(clouds.random_cloud(30, 0), "S")
    assert read(obj) is None
    obj.data.attributes.remove(obj.data.attributes["radiance:base"])
    assert read_rest(obj, EVERY) is None


def test_splats_go_to_the_shader_and_come_back(window, tmp_path):
    obj = splat_object(clouds.random_cloud(30, 0), "S")
    bpy.context.view_layer.objects.active = obj
    switch.apply_to_all()
    assert switch.is_drawn(obj)
    for change, undo in (
        (lambda: set_display(obj, "Display", False), lambda: set_display(obj, "Display", True)),
        (lambda: bpy.ops.object.mode_set(mode="VERTEX_PAINT"), lambda: bpy.ops.object.mode_set(mode="OBJECT")),
        (lambda: setattr(bpy.context.scene, "gskin_draw_splats", False),
         lambda: setattr(bpy.context.scene, "gskin_draw_splats", True)),
        (lambda: switch.fail("no reason"), switch.try_again),
    ):  # fmt: skip
        change()
        switch.apply_to_all()
        assert not get_display(obj, BY_SHADER)
        undo()
        switch.apply_to_all()
        assert switch.is_drawn(obj)
    find_display(obj).show_viewport = False
    assert not switch.is_drawn(obj)
    find_display(obj).show_viewport = True
    # A saved file has ellipsoids, for a Blender without the add-on; what is open stays as it was.
    path = str(tmp_path / "saved.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
    with bpy.data.libraries.load(path) as (_, into):
        into.objects = ["S"]
    loaded = into.objects[0]
    assert get_input(find_display(loaded), BY_SHADER) is False


def test_turning_the_add_on_off_brings_ellipsoids_back(window):
    obj = splat_object(clouds.random_cloud(30, 0), "S")
    switch.apply_to_all()
    assert get_display(obj, BY_SHADER)
    following.unregister()
    assert not get_display(obj, BY_SHADER)
    following.register()


def test_nothing_is_given_to_the_shader_without_a_window():
    gskin_addon.register()
    try:
        obj = splat_object(clouds.random_cloud(30, 0), "S")
        switch.apply_to_all()
        assert bpy.context.scene.gskin_draw_splats
        assert not get_display(obj, BY_SHADER)
    finally:
        gskin_addon.unregister()


def test_a_display_of_an_older_file_can_be_renewed(window):
    obj = splat_object(clouds.random_cloud(30, 0), "S")
    modifier = add_display(obj)
    older = modifier.node_group.copy()
    older["gskin_version"] = 3
    older.interface.remove(next(i for i in older.interface.items_tree if i.name == BY_SHADER))
    modifier.node_group = older
    set_display(obj, "Size", 0.5)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    assert not has_input(modifier, BY_SHADER)
    assert not switch.is_drawn(obj)
    assert bpy.ops.gskin.renew_display() == {"FINISHED"}
    assert get_display(obj, "Size") == 0.5
    assert get_input(modifier, OCTAHEDRA) is not None
    assert not bpy.ops.gskin.renew_display.poll()
    switch.apply_to_all()
    assert switch.is_drawn(obj)


def test_only_what_changed_is_read_again(monkeypatch):
    obj, armature = bound()
    layer = bpy.context.view_layer
    reads = []
    monkeypatch.setattr(visible, "read_rest", lambda *a: reads.append("rest") or read_rest(*a))
    monkeypatch.setattr(visible, "read_posed", lambda *a: reads.append("posed") or read_posed(*a))

    def shown():
        reads.clear()
        layer.update()
        return visible.shown_objects(bpy.context)

    visible.forget()
    first = shown()
    assert [one.obj for one in first] == [obj]
    assert reads == ["rest", "posed"]
    assert shown()[0].pose_key == first[0].pose_key
    assert not reads
    rigs.random_pose(armature, np.random.default_rng(9))
    visible.pose_changed(obj)
    second = shown()
    assert reads == ["posed"]
    assert second[0].rest_key == first[0].rest_key
    assert second[0].pose_key != first[0].pose_key
    assert np.abs(second[0].splats.points - first[0].splats.points).max() > 0.01
    cloud = clouds.random_cloud(60, 2, seed=8)
    replace_cloud(obj, cloud)
    visible.rest_changed(obj)
    visible.pose_changed(obj)
    third = shown()[0]
    assert reads == ["rest", "posed"]
    np.testing.assert_allclose(third.splats.sh, cloud.sh, atol=1e-6)


def test_hidden_objects_are_not_shown():
    obj, _ = bound()
    layer = bpy.context.view_layer

    def shown():
        layer.update()
        return [one.obj for one in visible.shown_objects(bpy.context)]

    assert shown() == [obj]
    obj.hide_set(True)
    assert not shown()
    obj.hide_set(False)
    obj.hide_viewport = True
    layer.update()
    assert not shown()
    obj.hide_viewport = False
    home = bpy.data.collections.new("Home")
    bpy.context.scene.collection.children.link(home)
    bpy.context.scene.collection.objects.unlink(obj)
    home.objects.link(obj)
    layer.update()
    assert shown() == [obj]
    layer.layer_collection.children["Home"].exclude = True
    layer.update()
    assert not shown()


def test_instances_of_a_collection_are_shown_where_they_are():
    obj, _ = bound(degree=0)
    source = bpy.data.collections.new("Source")
    bpy.context.scene.collection.objects.unlink(obj)
    source.objects.link(obj)
    empties = []
    for place in ((3.0, 0.0, 0.0), (-3.0, 0.0, 1.0)):
        empty = bpy.data.objects.new("Copy", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", source, place
        bpy.context.scene.collection.objects.link(empty)
        empties.append(empty)
    empties[0].rotation_euler.z = 1.0
    bpy.context.view_layer.update()
    shown = visible.shown_objects(bpy.context)
    assert {one.obj for one in shown} == set(empties)
    for one in shown:
        wanted = np.array(one.obj.matrix_world) @ np.array(obj.matrix_world)
        np.testing.assert_allclose(one.splats.matrix, wanted, atol=1e-5)
    empties[1].hide_set(True)
    assert [one.obj for one in visible.shown_objects(bpy.context)] == [empties[0]]


def test_the_thread_runs_the_newest_job_of_each_asker():
    sorter, gate, begun = Sorter(), threading.Event(), threading.Event()
    ran = []

    def job(name):
        def run():
            begun.set()
            gate.wait(HANG)
            ran.append(name)
            return name

        return run

    sorter.ask("a", 1, job("a1"))
    assert begun.wait(HANG)  # else the second would take the place of the first before it runs
    sorter.ask("a", 2, job("a2"))
    sorter.ask("a", 3, job("a3"))
    sorter.ask("b", 1, job("b1"))
    gate.set()
    wait_for(lambda: not sorter.is_busy())
    assert sorter.has_results()
    assert sorter.take("a") == (3, "a3")
    assert sorter.take("b") == (1, "b1")
    assert sorter.take("a") is None
    assert "a2" not in ran
    sorter.ask("c", 1, lambda: 1 / 0)
    wait_for(lambda: not sorter.is_busy())
    with pytest.raises(ZeroDivisionError):
        sorter.take("c")
    sorter.forget()
    wait_for(lambda: not [t for t in threading.enumerate() if t.name == "gskin-sorter"])
    sorter.ask("a", 4, lambda: "again")
    wait_for(sorter.has_results)
    assert sorter.take("a") == (4, "again")
    sorter.forget()


def wait_for(condition) -> None:
    pause = threading.Event()
    for _ in range(2000):
        if condition():
            return
        pause.wait(0.005)
    raise AssertionError("waited ten seconds")
