# SPDX-License-Identifier: GPL-3.0-or-later
"""True splats in Edit Mode and Weight Paint: what the shader is given there, whose colours it has, what is marked.

Pictures need a window; nothing is drawn here.
"""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import bmesh

import gskin_addon
from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.colors import weight_colors
from gskin_addon.scene import fabric_view, names
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.display_inputs import BY_SHADER, NATIVE
from gskin_addon.scene.fabric import has_fabric, iter_make_fabric
from gskin_addon.scene.node_builder import has_input
from gskin_addon.scene.node_groups import add_display, find_display, get_display, set_display
from gskin_addon.scene.overlay import is_of_before, set_overlay, show_moves_with, show_stretch
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.rotation_nodes import find_rotation
from gskin_addon.scene.selecting import posed_points
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.viewport import cages, following, marks, selection, switch, visible
from gskin_addon.scene.weights import read_weights, write_weights

COUNT, BONES = 400, 5
LOOK = marks.Look((0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (1.0, 0.6, 0.0), (1.0, 1.0, 1.0), 3.0)


@pytest.fixture(scope="module", autouse=True)
def registered():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def scene(monkeypatch):
    """Splats on a ball, with harmonics, a fabric and a pose, as in a window; there is none here."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    monkeypatch.setattr(switch, "wanted", lambda scene: switch.setting(scene))
    rng = np.random.default_rng(4)
    cloud = clouds.random_cloud(COUNT, 1)
    means = rng.normal(size=(COUNT, 3))
    cloud.means[:] = means / np.linalg.norm(means, axis=1, keepdims=True)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    if has_input(add_display(obj), NATIVE):
        set_display(obj, NATIVE, False)
    write_weights(obj, armature, rigs.random_weights(cloud, BONES, rng), confidence=np.linspace(0, 1, COUNT))
    run_to_end(iter_make_fabric(obj))
    rigs.random_pose(armature, rng, 0.5)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    switch.apply_to_all()
    visible.forget()
    cages.forget()
    return obj, armature


def mode(name: str) -> None:
    bpy.ops.object.mode_set(mode=name)
    bpy.context.view_layer.update()


def noticed(obj):
    """What the handlers of a window note of a change, and what is shown after it."""
    selection.changed(obj)
    visible.pose_changed(obj)
    visible.rest_changed(obj)
    switch.apply_to(obj)
    fabric_view.apply_to(obj)
    bpy.context.view_layer.update()
    return visible.shown_objects(bpy.context)


def test_edit_mode_shows_the_posed_splats_and_draws_nothing_anew(scene):
    obj, _ = scene
    wanted = posed_cloud(obj)
    before = noticed(obj)[0]
    mode("EDIT")
    inside = noticed(obj)[0]
    assert switch.is_drawn(obj)
    assert find_display(obj).show_viewport
    np.testing.assert_allclose(inside.splats.points, wanted.means, atol=1e-5)
    assert inside.splats.sh.shape[1] == 4, "harmonics"
    assert (inside.rest_key, inside.pose_key) == (before.rest_key, before.pose_key)
    mode("OBJECT")
    after = noticed(obj)[0]
    assert (after.rest_key, after.pose_key) == (before.rest_key, before.pose_key)


def test_edit_mode_knows_where_its_splats_are(scene):
    """The display adds points of its own for the shader; they are no splats."""
    obj, _ = scene
    wanted = posed_cloud(obj).means
    noticed(obj)
    mode("EDIT")
    noticed(obj)
    np.testing.assert_allclose(posed_points(obj), wanted, atol=1e-5)
    bpy.ops.mesh.select_all(action="SELECT")
    view = np.eye(4)
    view[2, 3] = -5
    lens = np.diag([0.5, 0.5, -0.02, 1.0])
    bpy.ops.gskin.select_in_front(view=view.ravel(), lens=lens.ravel(), depth=3)
    front = np.array([vert.select for vert in bmesh.from_edit_mesh(obj.data).verts])
    assert wanted[front, 2].mean() > wanted[~front, 2].mean()


def test_undo_in_edit_mode_keeps_the_harmonics(scene):
    obj, _ = scene
    before = noticed(obj)[0]
    mode("EDIT")
    noticed(obj)
    visible.forget()  # as after each undo
    inside = noticed(obj)[0]
    assert inside.pose_key == before.pose_key
    assert inside.splats.sh.shape[1] == 4


def test_edit_mode_shows_the_chosen_colours(scene):
    obj, _ = scene
    weights = read_weights(obj)[0]
    assert noticed(obj)[0].splats.colors is None
    mode("EDIT")
    set_overlay(obj, "BONES")
    np.testing.assert_allclose(noticed(obj)[0].splats.colors, weight_colors(weights), atol=3e-3)
    set_overlay(obj, "CONFIDENCE")
    colors = noticed(obj)[0].splats.colors
    np.testing.assert_allclose(colors[[0, -1]], [[1, 0, 0], [0, 0, 1]], atol=2e-3)
    set_overlay(obj, "NONE")
    assert noticed(obj)[0].splats.colors is None


def test_what_is_edited_is_what_is_shown(scene):
    """Hidden splats go, moved ones are elsewhere, removed ones are no more."""
    obj, _ = scene
    mode("EDIT")
    whole = noticed(obj)[0]
    choose([3, 5, 8])
    bpy.ops.mesh.hide()
    shown = noticed(obj)[0]
    assert np.flatnonzero(shown.splats.opacities == 0).tolist() == [3, 5, 8]
    assert shown.rest_key != whole.rest_key, "else the colours of before are drawn"
    bpy.ops.mesh.reveal(select=False)
    assert noticed(obj)[0].rest_key == whole.rest_key
    choose([7])
    work = bmesh.from_edit_mesh(obj.data)
    work.verts.ensure_lookup_table()
    work.verts[7].co.z += 0.5
    bmesh.update_edit_mesh(obj.data)
    moved = np.linalg.norm(noticed(obj)[0].splats.points - whole.splats.points, axis=1)
    assert np.flatnonzero(moved > 0.1).tolist() == [7]
    choose([0, 1])
    bpy.ops.mesh.delete(type="VERT")
    rest = noticed(obj)[0]
    assert rest.splats.count == COUNT - 2
    np.testing.assert_allclose(rest.splats.opacities, whole.splats.opacities[2:], atol=1e-6)


def choose(index) -> None:
    """Select points in Edit Mode, the last one as if it were clicked."""
    bpy.ops.mesh.select_all(action="DESELECT")
    obj = bpy.context.object
    work = bmesh.from_edit_mesh(obj.data)
    work.verts.ensure_lookup_table()
    for one in index:
        work.verts[one].select_set(True)
    work.select_history.clear()
    work.select_history.add(work.verts[index[-1]])
    bmesh.update_edit_mesh(obj.data)


def test_marks_are_of_the_selected_points(scene):
    obj, _ = scene
    assert cages.edited_cages(bpy.context, noticed(obj)) == []
    mode("EDIT")
    choose([4, 9])
    shown = noticed(obj)
    (cage,) = cages.edited_cages(bpy.context, shown)
    assert np.flatnonzero(cage.selected).tolist() == [4, 9]
    assert cage.active == 9
    assert len(cage.triangles) == len(obj.data.polygons) > 0
    np.testing.assert_allclose(cage.points, posed_cloud_of(obj), atol=1e-5)
    choose([2])
    noticed(obj)
    (other,) = cages.edited_cages(bpy.context, shown)
    assert np.flatnonzero(other.selected).tolist() == [2]
    assert other.key != cage.key
    assert other.solid_key == cage.solid_key, "the depths are drawn again for nothing"


def posed_cloud_of(obj):
    mode("OBJECT")
    means = posed_cloud(obj).means
    mode("EDIT")
    return means


@pytest.mark.parametrize("parallel", [False, True], ids=["perspective", "orthographic"])
def test_marks_lie_where_the_points_are_seen(parallel):
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (50, 3)).astype(np.float32)
    edges = np.stack((np.arange(49), np.arange(1, 50)), axis=1).astype(np.int32)
    selected, hidden = np.zeros((2, 50), np.bool_)
    selected[[3, 4, 20]], hidden[10] = True, True
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    view = np.eye(4)
    view[2, 3] = -8.0
    if parallel:
        projection = np.diag([0.2, 0.3, -2 / 20, 1.0])
        projection[2, 3] = -1.0
    else:
        projection = np.array([[1.5, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1.02, -0.2], [0, 0, -1, 0]])
    cage = marks.Cage(points, matrix, selected, hidden, 4, np.empty((0, 3), np.int32), edges, 0, 0)
    made = marks.lay_out([cage], view, projection, (800, 600), LOOK)
    clip = np.c_[points, np.ones(50)] @ (projection @ view @ matrix).T
    ndc = clip[:, :3] / clip[:, 3:]
    kinds = {name: np.flatnonzero((made.color == getattr(LOOK, name)).all(axis=1)) for name in
             ("point", "selected", "edge", "active")}  # fmt: skip
    np.testing.assert_allclose(made.start[kinds["selected"], :2], ndc[selected, :2], atol=1e-5)
    assert (made.start[kinds["selected"], 2] < ndc[selected, 2]).all(), "before the triangles that meet there"
    np.testing.assert_allclose(made.start[kinds["point"], :2], ndc[~selected & ~hidden, :2], atol=1e-5)
    np.testing.assert_allclose(made.start[kinds["edge"], :2], ndc[[3], :2], atol=1e-5)
    np.testing.assert_allclose(made.end[kinds["edge"], :2], ndc[[4], :2], atol=1e-5)
    np.testing.assert_allclose(made.start[kinds["active"], :2], ndc[[4], :2], atol=1e-5)
    assert kinds["active"][0] == len(made.start) - 1, "drawn over the others"
    assert made.opacity == 1.0
    behind = marks.lay_out([cage], np.diag([1.0, 1.0, -1.0, 1.0]) @ view, projection, (800, 600), LOOK)
    assert parallel or not len(behind.start)


def test_many_marks_let_the_splats_shine_through():
    count = 70_000
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (count, 3)).astype(np.float32)
    every, none = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    edges = np.empty((0, 2), np.int32)
    cage = marks.Cage(points, np.eye(4), every, none, -1, np.empty((0, 3), np.int32), edges, 0, 0)
    made = marks.lay_out([cage], np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), (800, 600), LOOK)
    assert made.opacity == marks.FAINTEST
    assert 0 < len(made.start) <= marks.MOST
    assert not made.rim.any()


def test_weight_paint_shows_weights_on_the_fabric_unless_other_colours_are_chosen(scene):
    obj, _ = scene
    weights = read_weights(obj)[0]
    mode("WEIGHT_PAINT")
    assert noticed(obj) == []
    assert not find_display(obj).show_viewport, "the fabric is seen"
    set_overlay(obj, "BONES")
    shown = noticed(obj)
    assert find_display(obj).show_viewport
    np.testing.assert_allclose(shown[0].splats.colors, weight_colors(weights), atol=3e-3)
    bpy.context.scene.gskin_show_in_paint = False
    assert noticed(obj) == []
    assert not find_display(obj).show_viewport
    bpy.context.scene.gskin_show_in_paint = True
    assert len(noticed(obj)) == 1
    set_overlay(obj, "NONE")
    assert noticed(obj) == []
    mode("OBJECT")
    assert len(noticed(obj)) == 1


def test_colours_in_weight_paint_follow_the_weights(scene):
    """Painted weights are read where their splats are seen, else when Weight Paint is left."""
    obj, _ = scene
    group = obj.vertex_groups[0]
    mode("WEIGHT_PAINT")

    def paint(splat: int) -> float:
        for one in obj.vertex_groups:
            one.remove([splat])
        group.add([splat], 1.0, "REPLACE")
        obj.data.update()
        bpy.context.view_layer.update()
        noticed(obj)
        return float(read_attribute(obj.data, names.WEIGHT.format(0))[splat])

    assert paint(3) < 1.0, "nobody sees it yet"
    set_overlay(obj, "BONES")
    noticed(obj)
    assert paint(5) == 1.0
    colors = noticed(obj)[0].splats.colors
    np.testing.assert_allclose(colors[[3, 5]], [weight_colors(np.eye(BONES))[0]] * 2, atol=3e-3)
    obj.vertex_groups.active_index = 1
    set_overlay(obj, "WEIGHTS")
    obj.vertex_groups.active_index = 2
    following.follow_active_group(obj)
    assert get_display(obj, "Show Weights Of") == obj.vertex_groups[2].name


def test_what_moves_with_a_splat_follows_the_weights_and_stretch_says_that_it_does_not(scene):
    obj, armature = scene
    assert bpy.ops.gskin.show_moves_with(splat=6) == {"FINISHED"}
    show_stretch(obj, np.ones(COUNT))
    assert not is_of_before(obj)
    weights = np.zeros((COUNT, BONES), np.float32)
    weights[:, 0] = 1
    weights[: COUNT // 2] = (0, 1, 0, 0, 0)
    write_weights(obj, armature, weights)
    assert is_of_before(obj)
    alike = read_attribute(obj.data, names.ALIKE)
    np.testing.assert_allclose(alike, np.arange(COUNT) < COUNT // 2, atol=1e-5)
    show_stretch(obj, np.ones(COUNT))
    assert not is_of_before(obj)


@pytest.mark.parametrize("name", ["EDIT", "WEIGHT_PAINT"])
def test_what_moves_with_this_is_shown_in_the_mode_where_it_was_asked(scene, name):
    obj, _ = scene
    mode("EDIT")
    choose([6])
    mode(name)
    assert bpy.ops.gskin.show_moves_with() == {"FINISHED"}
    assert obj.mode == name
    shown = noticed(obj)[0]
    np.testing.assert_allclose(shown.splats.colors[6], (1, 0, 0), atol=2e-3)
    if name == "EDIT":
        assert np.flatnonzero(selection.flags_of(obj).selected).tolist() == [6]


def test_where_the_shader_does_not_draw_edit_mode_is_left_to_the_fabric(scene):
    obj, _ = scene
    assert find_rotation(obj).show_in_editmode
    bpy.context.scene.gskin_draw_splats = False
    switch.apply_to_all()
    assert not find_rotation(obj).show_in_editmode
    assert not find_display(obj).show_in_editmode
    mode("EDIT")
    assert noticed(obj) == []
    assert not get_display(obj, BY_SHADER)
    assert not find_display(obj).show_viewport
    assert has_fabric(obj)
    mode("OBJECT")
    bpy.context.scene.gskin_draw_splats = True


def test_colours_by_a_splat_are_refused_in_edit_mode(scene):
    """Whoever goes there while the weights are read must not meet half of them."""
    obj, _ = scene
    mode("EDIT")
    with pytest.raises(InputError, match="is in Edit Mode"):
        show_moves_with(obj, np.array([1]))
