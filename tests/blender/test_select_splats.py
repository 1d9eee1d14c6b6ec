# SPDX-License-Identifier: GPL-3.0-or-later
"""The select operators in Edit Mode and Weight Paint, and the ways in which selections meet."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")
import bmesh

import gskin_addon
from gskin_addon.core.splats.cloud import SH_C0
from gskin_addon.operators import _sliced, select_splats
from gskin_addon.operators._selecting import SelectSplats, combined
from gskin_addon.scene import names, selecting
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.fabric import iter_make_fabric
from gskin_addon.scene.seams import write_seams
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.stand_in import readable
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.weights import read_weights, write_weights
from gskin_addon.ui import select_menu

COUNT, BONES = 400, 4


@pytest.fixture(scope="module")
def session():
    """A sphere of splats, red above and blue below, one half of it not sure."""
    gskin_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(4)
    cloud = clouds.random_cloud(COUNT, 0)
    means = rng.normal(size=(COUNT, 3))
    cloud.means[:] = means / np.linalg.norm(means, axis=1, keepdims=True)
    upper = cloud.means[:, 2] > 0
    cloud.sh[:, 0] = (np.where(upper[:, None], (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)) - 0.5) / SH_C0
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    sure = np.where(np.abs(cloud.means[:, 0]) > 0.8, 0.1, 0.9) + rng.uniform(0, 0.01, COUNT)
    write_weights(obj, armature, rigs.random_weights(cloud, BONES, rng), confidence=sure)
    run_to_end(iter_make_fabric(obj))
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    yield obj
    gskin_addon.unregister()


@pytest.fixture
def splats(session):
    if session.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    session.data.vertices.foreach_set("hide", np.zeros(COUNT, bool))
    select(session, np.zeros(COUNT, bool))
    return session


def select(obj, mask):
    obj.data.vertices.foreach_set("select", mask)
    obj.data.update()


def selected(obj):
    """What Edit Mode has selected, after leaving it."""
    mode = obj.mode
    if mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")
    mask = np.zeros(COUNT, bool)
    obj.data.vertices.foreach_get("select", mask)
    return mask


def test_ways_of_selecting():
    before, found = np.array([1, 1, 0, 0], bool), np.array([1, 0, 1, 0], bool)
    assert {way: combined(way, before, found).astype(int).tolist() for way in ("SET", "ADD", "SUB", "AND")} == {
        "SET": [1, 0, 1, 0], "ADD": [1, 1, 1, 0], "SUB": [0, 1, 0, 0], "AND": [1, 0, 0, 0],
    }  # fmt: skip


def test_by_bone_with_every_way_and_hidden_splats(splats):
    weights, bones = read_weights(splats)
    wanted = weights[:, 1] >= 0.4
    assert 10 < wanted.sum() < COUNT - 10
    assert bpy.ops.gskin.select_by_bone(bone=bones[1], least=0.4) == {"FINISHED"}
    assert splats.mode == "EDIT"
    np.testing.assert_array_equal(selected(splats), wanted)
    splats.vertex_groups.active_index = splats.vertex_groups.find(bones[2])
    bpy.ops.gskin.select_by_bone(least=0.4, mode="ADD")
    np.testing.assert_array_equal(selected(splats), wanted | (weights[:, 2] >= 0.4))
    bpy.ops.gskin.select_by_bone(bone=bones[1], least=0.4, mode="SUB")
    assert not (selected(splats) & wanted).any()
    hidden = np.arange(COUNT) % 2 == 0
    splats.data.vertices.foreach_set("hide", hidden)
    bpy.ops.gskin.select_by_bone(bone=bones[1], least=0.4)
    np.testing.assert_array_equal(selected(splats), wanted & ~hidden)
    with pytest.raises(RuntimeError, match="no deform bone"):
        bpy.ops.gskin.select_by_bone(bone="nobody")


def test_edges_and_faces_between_go_along(splats):
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.gskin.select_by_bone(bone="bone.001", least=0.3)
    work = bmesh.from_edit_mesh(splats.data)
    for element in (*work.edges, *work.faces):
        assert element.select == all(vert.select for vert in element.verts)
    assert 10 < sum(face.select for face in work.faces) < len(work.faces) - 10


def test_what_is_marked_outside_of_edit_mode_is_what_it_shows(splats):
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")  # with it edges and faces of the fabric
    bpy.ops.object.mode_set(mode="OBJECT")
    mask = np.arange(COUNT) % 3 == 0
    selecting.mark_selected(splats, mask)
    bpy.ops.object.mode_set(mode="EDIT")
    np.testing.assert_array_equal(selected(splats), mask)


def test_by_color_of_the_selected_or_the_active_splat(splats):
    upper = read_cloud(splats).sh[:, 0, 0] > 0
    with pytest.raises(RuntimeError, match="select one of the colour"):
        bpy.ops.gskin.select_by_color()
    select(splats, np.arange(COUNT) == np.flatnonzero(upper)[0])
    bpy.ops.gskin.select_by_color(tolerance=0.05)
    np.testing.assert_array_equal(selected(splats), upper)
    bpy.ops.gskin.select_by_color(color=(0.1, 0.1, 0.8))
    np.testing.assert_array_equal(selected(splats), ~upper)
    bpy.ops.object.mode_set(mode="EDIT")
    work = bmesh.from_edit_mesh(splats.data)
    work.verts.ensure_lookup_table()
    vert = work.verts[int(np.flatnonzero(upper)[3])]
    vert.select_set(True)
    work.select_history.add(vert)
    bpy.ops.gskin.select_by_color()
    np.testing.assert_array_equal(selected(splats), upper)


def test_linked_stops_at_seams_and_grows_along_the_body(splats):
    means = read_cloud(splats).means
    start = np.zeros(COUNT, bool)
    start[means[:, 2].argmax()] = True
    select(splats, start)
    bpy.ops.gskin.select_linked_splats()
    assert selected(splats).mean() > 0.95
    band = np.abs(means[:, 2]) < 0.6
    write_seams(splats, np.where(band, np.where(means[:, 2] > 0, 1, 2), 0))
    select(splats, start)
    bpy.ops.gskin.select_linked_splats()
    assert (selected(splats) == (means[:, 2] > 0)).mean() > 0.97
    write_seams(splats, None)
    select(splats, start)
    bpy.ops.gskin.grow_splat_selection(unit="LENGTH", length=0.7)
    near = selected(splats)
    angle = np.arccos(np.clip(means @ means[start][0], -1, 1))
    assert near[angle < 0.5].all()
    assert not near[angle > 0.72].any()
    bpy.ops.gskin.shrink_splat_selection(steps=2.0)
    assert 0 < selected(splats).sum() < near.sum()


def test_front_side_only(splats, monkeypatch):
    means = read_cloud(splats).means
    select(splats, np.ones(COUNT, bool))
    view = np.eye(4)
    view[2, 3] = -5
    lens = np.diag([0.5, 0.5, -0.02, 1.0])
    bpy.ops.gskin.select_in_front(view=view.ravel(), lens=lens.ravel(), depth=3)
    front = selected(splats)
    assert front[means[:, 2] > 0.5].mean() > 0.9
    assert front[means[:, 2] < -0.5].mean() < 0.2, "400 splats leave holes"
    monkeypatch.setattr(select_splats, "_region_view", lambda context: None)
    with pytest.raises(RuntimeError, match="No 3D view"):
        bpy.ops.gskin.select_in_front()


def test_edit_mode_knows_where_the_pose_puts_the_splats(splats):
    armature = splats.modifiers[0].object
    rigs.random_pose(armature, np.random.default_rng(2), 0.8)
    bpy.context.view_layer.update()
    posed = selecting.posed_points(splats)
    bpy.ops.object.mode_set(mode="EDIT")
    np.testing.assert_allclose(selecting.posed_points(splats), posed, atol=1e-5)
    for bone in armature.pose.bones:
        bone.matrix_basis.identity()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(selecting.posed_points(splats), read_points(splats), atol=1e-5)
    assert np.abs(posed - read_points(splats)).max() > 0.1


def read_points(obj):
    with readable(obj) as there:
        return read_cloud(there).means


def test_by_bone_knows_weights_that_were_changed_in_edit_mode(splats):
    before, bones = read_weights(splats)
    sure = read_attribute(splats.data, names.CONFIDENCE)
    selecting.enter_edit_mode(bpy.context, splats, np.arange(COUNT) < 50)
    bpy.ops.gskin.assign_to_bone(bone=bones[3])
    bpy.ops.gskin.select_by_bone(bone=bones[3], least=0.99)
    found = selected(splats)
    assert found[:50].all()
    np.testing.assert_array_equal(found[50:], before[50:, 3] >= 0.99)
    write_weights(splats, splats.modifiers[0].object, before, confidence=sure)


def test_in_weight_paint_the_mode_stays(splats):
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    assert bpy.ops.gskin.select_by_bone(bone="bone.001", least=0.4) == {"FINISHED"}
    assert splats.mode == "WEIGHT_PAINT"
    assert splats.data.use_paint_mask_vertex
    np.testing.assert_array_equal(selected(splats), read_weights(splats)[0][:, 1] >= 0.4)


def test_unsure_clusters_one_after_the_other(splats):
    means = read_cloud(splats).means
    sides = []
    for step in (1, 1, 1, -1):
        assert bpy.ops.gskin.next_unsure_cluster(step=step, worst=19.0) == {"FINISHED"}
        mask = selected(splats)
        sides.append(np.sign(means[mask, 0].mean()))
        assert (np.abs(means[mask, 0]) > 0.75).all()
        assert 15 < mask.sum() < 60
    assert sides == [sides[0], -sides[0], sides[0], -sides[0]], "two caps, round and round"
    bpy.ops.gskin.select_unsure_splats(worst=10, mode="ADD")
    assert selected(splats).sum() > mask.sum()
    assert names.CONFIDENCE in splats.data.attributes


def test_blenders_select_menus_have_them_for_splats_alone(splats):
    class Layout:
        def __init__(self):
            self.drawn = []

        def separator(self):
            pass

        def operator(self, name):
            self.drawn.append(name)

    for active, count in ((splats, len(select_menu.OPERATORS)), (bpy.data.objects["Rig"], 0)):
        bpy.context.view_layer.objects.active = active
        menu = type("Menu", (), {"layout": Layout()})()
        select_menu.draw(menu, bpy.context)
        assert len(menu.layout.drawn) == count
        for name in menu.layout.drawn:
            getattr(bpy.ops.gskin, name.removeprefix("gskin.")).get_rna_type()
    bpy.context.view_layer.objects.active = splats
    for name in select_menu.MENUS:
        assert select_menu.draw in getattr(bpy.types, name)._dyn_ui_initialize()


TIMER, ESCAPE = (SimpleNamespace(type=kind, value="PRESS") for kind in ("TIMER", "ESC"))


class Click(SelectSplats):
    """Select Linked as a person clicks it."""

    bl_label = "Click"
    mode = "SET"
    find = select_splats.GSKIN_OT_select_linked_splats.find

    def __init__(self):
        self.said = []

    def report(self, kind, text):
        self.said.append((*kind, text))


@pytest.fixture
def window(splats, monkeypatch):
    """A window as Blender gives it, with the splats in Edit Mode, one of them selected, and no graph known."""
    monkeypatch.setattr(_sliced, "BUDGET", 0.0)
    monkeypatch.setattr(_sliced, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
    monkeypatch.setattr(selecting, "_graphs", {})
    manager = SimpleNamespace(
        event_timer_add=lambda pause, window: pause, event_timer_remove=lambda timer: None,
        modal_handler_add=lambda operator: None,
    )  # fmt: skip
    selecting.enter_edit_mode(bpy.context, splats, np.arange(COUNT) == 7)
    return SimpleNamespace(
        window=object(), window_manager=manager, workspace=None, view_layer=bpy.context.view_layer,
        tool_settings=bpy.context.tool_settings, active_object=splats, object=splats, selected_objects=[splats],
        scene=bpy.context.scene,
    )  # fmt: skip


def test_the_graph_of_the_first_click_is_made_beside_blender(splats, window, monkeypatch):
    threads, make = [], selecting.body_graph

    def noted(*args, **options):
        threads.append(threading.current_thread())
        return make(*args, **options)

    monkeypatch.setattr(selecting, "body_graph", noted)
    click = Click()
    assert click.invoke(window, None) == {"RUNNING_MODAL"}
    assert not threads, "the click itself returns at once"
    while (answer := click.modal(window, TIMER)) == {"RUNNING_MODAL"}:
        assert splats.mode == "EDIT", "leaving it and coming back would draw all splats twice"
    assert answer == {"FINISHED"}
    assert threads
    assert threading.main_thread() not in threads
    assert splats.mode == "EDIT"
    found = selected(splats)
    assert click.said == [("INFO", f"{found.sum()} of {COUNT} splats selected")]
    select(splats, np.arange(COUNT) == 7)
    bpy.ops.gskin.select_linked_splats()
    np.testing.assert_array_equal(selected(splats), found)
    assert len(threads) == 1, "the graph is kept"


def test_done_again_from_the_panel_it_is_done_at_once(splats, window):
    click = Click()
    click.invoke(window, None)
    while click.modal(window, TIMER) == {"RUNNING_MODAL"}:
        pass
    assert click.execute(window) == {"FINISHED"}, "the same operator, and nobody clicked"


def test_escape_leaves_mode_and_selection(splats, window):
    click = Click()
    click.invoke(window, None)
    objects, meshes = len(bpy.data.objects), len(bpy.data.meshes)
    click.modal(window, TIMER)
    assert splats.mode == "EDIT"
    assert len(bpy.data.objects) == objects + 1, "a copy is read"
    assert click.modal(window, ESCAPE) == {"CANCELLED"}
    assert splats.mode == "EDIT"
    assert (len(bpy.data.objects), len(bpy.data.meshes)) == (objects, meshes)
    np.testing.assert_array_equal(selected(splats), np.arange(COUNT) == 7)


@pytest.mark.parametrize("how", ["hidden", "excluded"])
def test_what_cannot_be_seen_is_not_selected_in(splats, how):
    """Blender has no Edit Mode for it; a sentence says so instead of a fault."""
    scene, shelf = bpy.context.scene, bpy.data.collections.new("Shelf")
    homes = list(splats.users_collection)
    scene.collection.children.link(shelf)
    scene.gskin.splats = splats
    write_seams(splats, np.arange(COUNT) % 3)
    if how == "hidden":
        splats.hide_set(True)
    else:
        shelf.objects.link(splats)
        for home in homes:
            home.objects.unlink(splats)
        bpy.context.view_layer.layer_collection.children["Shelf"].exclude = True
    try:
        for click in ("select_by_bone", "select_unsure_splats", "next_unsure_cluster", "select_seams"):
            options = {"bone": read_weights(splats)[1][0]} if click == "select_by_bone" else {}
            with pytest.raises(RuntimeError, match=r"Error: 'S' is (hidden|in a collection that is excluded)"):
                getattr(bpy.ops.gskin, click)(**options)
    finally:
        write_seams(splats, None)
        scene.gskin.splats = None
        if how == "excluded":
            for home in homes:
                home.objects.link(splats)
        bpy.data.collections.remove(shelf)
        splats.hide_set(False)
        bpy.context.view_layer.objects.active = splats
        splats.select_set(True)
