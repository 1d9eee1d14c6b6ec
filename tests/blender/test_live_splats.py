# SPDX-License-Identifier: GPL-3.0-or-later
"""Whatever an artist does to weights, bones and objects, splats stay where numpy puts them, turned as it turns them."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.rig.lbs import skin_points, skin_quats, sparsify
from gskin_addon.core.rig.quaternion import quat_multiply, quat_to_matrix
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.sh import rotate_sh
from gskin_addon.scene import handlers, names, weights
from gskin_addon.scene.armature import pose_transforms_of
from gskin_addon.scene.attributes import read_attribute, write_attribute
from gskin_addon.scene.bone_frames import is_bone_frames
from gskin_addon.scene.compared import compared, is_edited, mark_edited
from gskin_addon.scene.fabric import has_fabric, iter_make_fabric
from gskin_addon.scene.influences import read_influences
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.rotation_nodes import find_rotation, frames_of
from gskin_addon.scene.seams import read_seams, write_seams
from gskin_addon.scene.splat_object import create_splat_object, is_splat_object, read_cloud
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.transforms import world_similarity
from gskin_addon.scene.weights import read_weights, write_weights

COUNT, BONES = 240, 6


@pytest.fixture(scope="module", autouse=True)
def registered():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@pytest.fixture
def rng():
    return np.random.default_rng(8)


@pytest.fixture
def scene(rng):
    """Splats with a fabric and their armature; the splats are chosen."""
    empty()
    return make(rng)


def empty():
    """Nothing in the file but node groups, which take a second to build."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.armatures, bpy.data.collections, bpy.data.libraries):
        bpy.data.batch_remove(list(kind))
    bpy.context.view_layer.update()


def make(rng, name="S", rig="Rig", count=COUNT, degree=1):
    cloud: SplatCloud = clouds.random_cloud(count, degree, seed=int(rng.integers(99)))
    obj, armature = create_splat_object(cloud, name), rigs.make_chains(BONES, rng, name=rig)
    rigs.place(obj, (0.5, -0.2, 0.3), (0.1, 0.9, -0.5), 0.7)
    write_weights(obj, armature, rigs.random_weights(cloud, BONES, rng))
    run_to_end(iter_make_fabric(obj))
    choose(obj)
    bpy.context.view_layer.update()
    return obj, armature


def choose(*objects):
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.select_all(action="DESELECT")
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[0]


def named(name):
    return bpy.data.objects[name]


def assert_right(obj, armature, rng):
    """Places, turns and harmonics of the splats in a new pose, as the node groups show them, against numpy.

    All bones of a splat move it, the four strongest turn it.
    """
    rigs.random_pose(armature, rng, 0.7)
    points, quats = rigs.posed_in_blender(obj)
    rest, transforms = read_cloud(obj), pose_transforms_of(armature)
    weights = read_weights(obj)[0].astype(np.float64)
    loose = weights.sum(axis=1) <= 0
    weights[loose, 0] = 1
    weights /= weights.sum(axis=1, keepdims=True)
    wanted = np.where(loose[:, None], rest.means, skin_points(rest.means.astype(np.float64), weights, transforms))
    turn = skin_quats(sparsify(weights, 4), transforms)
    turn[loose] = (1, 0, 0, 0)
    assert np.abs(points - wanted).max() < 2e-5 * np.linalg.norm(np.ptp(wanted, axis=0))
    assert rigs.angles_between(quats, quat_multiply(turn, rest.quats.astype(np.float64))).max() < 2e-4
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    own = read_attribute(evaluated.data, names.TURN).astype(np.float64)
    # The harmonics are drawn as those at rest, seen along a way that is turned back.
    shown = rotate_sh(rotate_sh(read_cloud(obj, world=False).sh, quat_to_matrix(own)), world_similarity(obj)[0])
    np.testing.assert_allclose(shown, rotate_sh(rest.sh, quat_to_matrix(turn)), atol=3e-3)


def edit(work):
    bpy.ops.object.mode_set(mode="EDIT")
    work()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()


# --- weights changed by hand


def in_weight_paint(obj):
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    bpy.ops.object.vertex_group_smooth(group_select_mode="ALL", factor=0.5, repeat=2)
    bpy.ops.object.mode_set(mode="OBJECT")


def in_edit_mode(obj):
    obj.vertex_groups.active_index = 2
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.object.vertex_group_assign()
    bpy.ops.object.mode_set(mode="OBJECT")


def levels(obj):
    obj.vertex_groups.active_index = 1
    bpy.ops.object.vertex_group_levels(group_select_mode="ACTIVE", gain=9.0, offset=0.2)


def by_script(obj):
    obj.vertex_groups["bone.003"].add([*range(100)], 0.9, "REPLACE")


def remove_group(obj):
    obj.vertex_groups.remove(obj.vertex_groups["bone.003"])


def swap_names(obj):
    one, other = obj.vertex_groups["bone.001"], obj.vertex_groups["bone.002"]
    one.name, other.name = "x", "bone.001"
    one.name = "bone.002"


def test_hand_edited_groups(scene, rng):
    obj, armature = scene
    assert not is_edited(obj)
    for change in (swap_names, in_weight_paint, by_script, levels, remove_group, in_edit_mode):
        before = np.concatenate(read_influences(obj))
        mark_edited(obj, False)
        change(obj)
        bpy.context.view_layer.update()
        assert (np.concatenate(read_influences(obj)) != before).any(), change
        assert is_edited(obj), change
        assert_right(obj, armature, rng)


def test_nothing_is_written_where_nothing_changed(scene, rng, monkeypatch):
    obj, armature = scene
    written = []
    monkeypatch.setattr(weights, "write_influences", lambda *_: written.append(True))
    rigs.random_pose(armature, rng)
    for mode in ("WEIGHT_PAINT", "EDIT", "OBJECT"):
        bpy.ops.object.mode_set(mode=mode)
        bpy.context.view_layer.update()
    group = next(group for group in obj.vertex_groups if group.name in {"bone.001"})
    index = next(v.index for v in obj.data.vertices if group.index in [g.group for g in v.groups])
    group.add([index], group.weight(index), "REPLACE")
    bpy.ops.object.vertex_group_sort()
    bpy.context.view_layer.update()
    assert not written
    assert not is_edited(obj)
    by_script(obj)
    bpy.context.view_layer.update()
    assert written


def test_splats_that_get_an_armature_by_hand_turn_with_it(rng):
    empty()
    cloud = clouds.random_cloud(COUNT, 1)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    for bone, column in zip(armature.data.bones, rigs.random_weights(cloud, BONES, rng).T, strict=True):
        group = obj.vertex_groups.new(name=bone.name)
        for index, weight in enumerate(column.tolist()):
            group.add([index], weight if weight > 0.15 else 0.0, "REPLACE")
    modifier = obj.modifiers.new("Mine", "ARMATURE")
    modifier.object = armature
    obj.modifiers.move(1, 0)
    bpy.context.view_layer.update()
    assert [m.name for m in obj.modifiers] == ["Mine", "GSkin Rotation", "GSkin Display"]
    assert modifier.show_on_cage
    assert_right(obj, armature, rng)


# --- bones


def test_added_bones(scene, rng):
    obj, armature = scene
    choose(armature)
    bpy.ops.object.mode_set(mode="EDIT")
    extra = armature.data.edit_bones.new("aaa")
    extra.head, extra.tail = (0, 0, -0.5), (0, 0, 0)
    armature.data.edit_bones["bone.000"].parent = extra
    bpy.ops.object.mode_set(mode="OBJECT")
    obj.vertex_groups.new(name="aaa").add([*range(50)], 0.8, "REPLACE")
    bpy.context.view_layer.update()
    assert [group.name for group in frames_of(obj).vertex_groups] == [bone.name for bone in armature.data.bones]
    assert_right(obj, armature, rng)
    assert sum(map(is_bone_frames, bpy.data.objects)) == 1


def test_renamed_bones_and_bones_that_deform_no_more(scene, rng):
    obj, armature = scene
    armature.data.bones["bone.002"].name = "knee"
    bpy.context.view_layer.update()
    assert not is_edited(obj)
    assert_right(obj, armature, rng)
    armature.data.bones["bone.001"].use_deform = False
    bpy.context.view_layer.update()
    assert_right(obj, armature, rng)
    armature.data.bones["bone.001"].use_deform = True
    bpy.context.view_layer.update()
    assert_right(obj, armature, rng)


def test_a_rig_made_symmetric(scene, rng):
    obj, armature = scene
    choose(armature)
    bpy.ops.object.mode_set(mode="EDIT")
    for bone in armature.data.edit_bones:
        bone.name += ".L"
        bone.select = bone.select_head = bone.select_tail = True
    bpy.ops.armature.symmetrize()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    assert len(armature.data.bones) == 2 * BONES
    assert_right(obj, armature, rng)
    choose(obj)
    assert bpy.ops.gskin.mirror_weights() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert_right(obj, armature, rng)


def test_a_deleted_armature_leaves_splats_at_rest_and_no_helper(scene, rng):
    obj, armature = scene
    settings = bpy.context.scene.gskin
    settings.armature, settings.splats = armature, obj
    rest = read_cloud(obj, world=False)
    rigs.random_pose(armature, rng)
    bpy.ops.ed.undo_push(message="before")
    choose(armature)
    bpy.ops.object.delete()
    bpy.ops.ed.undo_push(message="delete")
    bpy.context.view_layer.update()

    def assert_at_rest():
        obj = named("S")
        assert "Rig" not in bpy.data.objects
        assert not any(map(is_bone_frames, bpy.data.objects))
        assert not [mesh.name for mesh in bpy.data.meshes if "Bone Frames" in mesh.name]
        assert find_rotation(obj) is None
        points, quats = rigs.posed_in_blender(obj)
        np.testing.assert_allclose(points, read_cloud(obj).means, atol=1e-5)
        assert rigs.angles_between(quats, read_cloud(obj).quats.astype(float)).max() < 1e-5
        np.testing.assert_array_equal(read_cloud(obj, world=False).means, rest.means)
        assert len(obj.vertex_groups) == BONES

    assert_at_rest()
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    assert bpy.context.scene.gskin.armature == named("Rig")
    assert_right(named("S"), named("Rig"), rng)
    bpy.ops.ed.redo()
    bpy.context.view_layer.update()
    assert_at_rest()
    # Another one in the modifier that is left.
    other = rigs.make_chains(BONES, rng, name="Other")
    next(m for m in named("S").modifiers if m.type == "ARMATURE").object = other
    bpy.context.view_layer.update()
    assert_right(named("S"), other, rng)


def test_deleted_splats_leave_no_helper(scene):
    obj, _ = scene
    bpy.context.scene.gskin.splats = obj
    choose(obj)
    bpy.ops.object.delete()
    bpy.context.view_layer.update()
    assert not [o.name for o in bpy.data.objects if is_splat_object(o)]


# --- files, undo, copies


def test_undo_and_redo(scene, rng):
    obj, _ = scene
    bpy.ops.ed.undo_push(message="before")
    first = read_weights(obj)[0]
    levels(obj)
    bpy.ops.ed.undo_push(message="levels")
    bpy.context.view_layer.update()  # what turns the splats is written after the step, as in a window
    second = read_weights(obj)[0]
    obj.location.x += 1
    bpy.ops.ed.undo_push(message="move")
    for way, wanted in ((bpy.ops.ed.undo, second), (bpy.ops.ed.undo, first), (bpy.ops.ed.redo, second)):
        way()
        bpy.context.view_layer.update()
        np.testing.assert_array_equal(read_weights(named("S"))[0], wanted)
        assert_right(named("S"), named("Rig"), rng)


def test_saved_and_loaded_also_from_where_the_add_on_was_not(scene, rng, tmp_path):
    levels(scene[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert_right(named("S"), named("Rig"), rng)
    gskin_addon.unregister()
    try:
        by_script(named("S"))
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    finally:
        gskin_addon.register()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
    bpy.context.view_layer.update()
    assert_right(named("S"), named("Rig"), rng)


def test_appended_linked_and_overridden(scene, rng, tmp_path):
    obj, armature = scene
    figure = bpy.data.collections.new("Figure")
    bpy.context.scene.collection.children.link(figure)
    for one in (obj, armature):
        figure.objects.link(one)
        bpy.context.scene.collection.objects.unlink(one)
    path = str(tmp_path / "lib.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    for link in (False, True):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        with bpy.data.libraries.load(path, link=link) as (_, target):
            target.collections = ["Figure"]
        bpy.context.scene.collection.children.link(target.collections[0])
        bpy.context.view_layer.update()
        if not link:
            assert_right(named("S"), named("Rig"), rng)
            by_script(named("S"))
            bpy.context.view_layer.update()
            assert_right(named("S"), named("Rig"), rng)
            continue
        linked = target.collections[0]
        made = linked.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
        bpy.context.scene.collection.children.unlink(linked)
        bpy.context.view_layer.update()
        splats = next(o for o in made.all_objects if is_splat_object(o))
        rig = next(o for o in made.all_objects if o.type == "ARMATURE")
        assert_right(splats, rig, rng)


@pytest.mark.parametrize("linked", [False, True])
def test_duplicates(scene, rng, linked):
    obj, armature = scene
    choose(obj, armature)
    bpy.ops.object.duplicate(linked=linked)
    bpy.context.view_layer.update()
    copy, own = named("S.001"), named("Rig.001")
    assert_right(copy, own, rng)
    assert_right(obj, armature, rng)
    by_script(copy)
    bpy.context.view_layer.update()
    assert_right(copy, own, rng)
    assert_right(obj, armature, rng)


def test_several_armatures_each_with_its_splats(scene, rng):
    obj, armature = scene
    second, other = make(rng, "T", "Rig2")
    armature.data.bones["bone.001"].use_deform = False
    by_script(second)
    bpy.context.view_layer.update()
    assert_right(obj, armature, rng)
    assert_right(second, other, rng)
    # One that changes from one to the other.
    next(m for m in obj.modifiers if m.type == "ARMATURE").object = other
    bpy.context.view_layer.update()
    assert_right(obj, other, rng)


# --- hide, separate, join


def seen(cloud, key=None):
    """All values of the splats in one table, in an order of its own."""
    rows = np.concatenate([cloud.means, np.abs(cloud.quats), cloud.scales, cloud.sh.reshape(cloud.count, -1)], axis=1)
    return rows[np.lexsort(np.round(cloud.means, 4).T)]


def separate(obj, mask):
    choose(obj)
    edit(lambda: bpy.ops.mesh.select_all(action="DESELECT"))
    obj.data.vertices.foreach_set("select", mask)
    before = set(bpy.data.objects)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.separate(type="SELECTED")
    bpy.context.view_layer.update()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    (part,) = (o for o in bpy.data.objects if o not in before and is_splat_object(o))
    return part


def test_separate_and_join_again(scene, rng):
    obj, armature = scene
    write_seams(obj, (np.arange(COUNT) % 5 == 0).astype(int))
    write_attribute(obj.data, names.CONFIDENCE, "FLOAT", np.linspace(0, 1, COUNT))
    whole = read_cloud(obj)
    mask = whole.means[:, 2] > np.quantile(whole.means[:, 2], 0.4)
    part = separate(obj, mask)
    assert (len(part.data.vertices), len(obj.data.vertices)) == (mask.sum(), (~mask).sum())
    for one, rows in ((part, mask), (obj, ~mask)):
        np.testing.assert_allclose(seen(read_cloud(one)), seen(whole.select(rows)), atol=1e-5)
        assert has_fabric(one)
        assert find_display(one) is not None
        assert (read_seams(one) != 0).sum() == (rows & (np.arange(COUNT) % 5 == 0)).sum()
        assert_right(one, armature, rng)
    rigs.place(part, (1, 0, 0), (0.4, 0, 1.0), 1.3)
    moved, rest = read_cloud(part), read_cloud(obj)
    choose(obj, part)
    bpy.ops.object.join()
    bpy.context.view_layer.update()
    assert len(obj.data.vertices) == COUNT
    both = read_cloud(obj)
    np.testing.assert_allclose(
        seen(both), seen(both.select(slice(None)).__class__(
            means=np.concatenate([rest.means, moved.means]), quats=np.concatenate([rest.quats, moved.quats]),
            scales=np.concatenate([rest.scales, moved.scales]), sh=np.concatenate([rest.sh, moved.sh]),
            opacities=np.concatenate([rest.opacities, moved.opacities]),
        )), atol=2e-4,
    )  # fmt: skip
    assert (read_seams(obj) != 0).sum() == (np.arange(COUNT) % 5 == 0).sum()
    assert_right(obj, armature, rng)


def test_undo_of_separate_and_join(scene, rng):
    obj, _ = scene
    whole = read_cloud(obj)
    bpy.ops.ed.undo_push(message="before")
    separate(obj, np.arange(COUNT) < 100)
    bpy.ops.ed.undo_push(message="separated")
    part = next(o for o in bpy.data.objects if is_splat_object(o) and o != obj)
    rigs.place(part, (0, 0, 1), (0, 0, 1), 1.0)
    bpy.ops.ed.undo_push(message="moved")
    choose(obj, part)
    bpy.ops.object.join()
    bpy.ops.ed.undo_push(message="joined")
    bpy.context.view_layer.update()
    joined = read_cloud(named("S"))
    for way in (bpy.ops.ed.undo, bpy.ops.ed.redo):
        way()
        bpy.context.view_layer.update()
    np.testing.assert_allclose(seen(read_cloud(named("S"))), seen(joined), atol=1e-5)
    for _ in range(3):
        bpy.ops.ed.undo()
        bpy.context.view_layer.update()
    np.testing.assert_allclose(seen(read_cloud(named("S"))), seen(whole), atol=1e-6)
    assert_right(named("S"), named("Rig"), rng)


def test_joining_what_differs(scene, rng):
    """Another armature, other bones, another degree, no confidence, no fabric; and a mesh that is no splats."""
    obj, armature = scene
    write_attribute(obj.data, names.CONFIDENCE, "FLOAT", np.full(COUNT, 0.25))
    cloud = clouds.random_cloud(90, 2, seed=3)
    other = create_splat_object(cloud, "T")
    rigs.place(other, (0, 1, 0), (0.5, 0.2, 0.1), 1.9)
    world = read_cloud(other)
    choose(obj, other)
    bpy.ops.object.join()
    bpy.context.view_layer.update()
    both = read_cloud(obj)
    assert (both.count, both.sh_degree) == (COUNT + 90, 2)
    rows = np.array([np.abs(both.means - mean).sum(axis=1).argmin() for mean in world.means])
    assert rigs.angles_between(both.quats[rows].astype(float), world.quats.astype(float)).max() < 1e-3
    np.testing.assert_allclose(both.scales[rows], world.scales, rtol=1e-3)
    np.testing.assert_allclose(both.sh[rows], world.sh, atol=2e-3)
    sure = read_attribute(obj.data, names.CONFIDENCE)
    assert (sure[rows] == 1).all()
    assert (sure == 0.25).sum() == COUNT
    assert compared(obj) is None
    rigs.random_pose(armature, rng)
    points, _ = rigs.posed_in_blender(obj)
    np.testing.assert_allclose(points[rows], world.means, atol=1e-4)  # nothing moves them yet
    cube = bpy.data.objects.new("Cube", bpy.data.meshes.new("Cube"))
    cube.data.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    bpy.context.scene.collection.objects.link(cube)
    choose(obj, cube)
    bpy.ops.object.join()
    bpy.context.view_layer.update()
    assert np.isfinite(read_cloud(obj).quats).all()
    assert (read_cloud(obj).opacities == 0).sum() >= 3


def test_hidden_splats_keep_everything(scene, rng):
    obj, armature = scene
    before, painted = read_cloud(obj), read_weights(obj)[0]

    def hide():
        bpy.ops.mesh.select_all(action="DESELECT")
        bpy.ops.object.mode_set(mode="OBJECT")
        obj.data.vertices.foreach_set("select", np.arange(COUNT) < 60)
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.hide()

    edit(hide)
    assert sum(vertex.hide for vertex in obj.data.vertices) == 60
    assert_right(obj, armature, rng)
    np.testing.assert_array_equal(read_weights(obj)[0], painted)
    np.testing.assert_array_equal(read_cloud(obj).quats, before.quats)
    edit(lambda: bpy.ops.mesh.reveal())
    assert not sum(vertex.hide for vertex in obj.data.vertices)
    assert_right(obj, armature, rng)


def test_files_without_handlers_are_brought_in_line(scene, rng):
    obj, armature = scene
    gskin_addon.unregister()
    try:
        in_edit_mode(obj)
        armature.data.bones["bone.001"].use_deform = False
        handlers.refresh_all()
        assert_right(obj, armature, rng)
    finally:
        gskin_addon.register()


def test_with_a_window_it_comes_to_rest(scene, rng, monkeypatch):
    """In slices from a timer; what is written then is not taken for another edit."""
    obj, armature = scene
    monkeypatch.setattr(handlers, "_watched", lambda: True)
    monkeypatch.setattr(handlers, "BUDGET", 0.0)
    for change in (by_script, in_edit_mode, in_weight_paint):
        change(obj)
        bpy.context.view_layer.update()
        assert handlers._running, change
        calls = 0
        while handlers._go_on() is not None:
            calls += 1
            assert calls < 50
        bpy.context.view_layer.update()
        assert not handlers._running, change
        assert not handlers._changed, change
        assert_right(obj, armature, rng)
    # An edit in the middle begins anew.
    by_script(obj)
    bpy.context.view_layer.update()
    handlers._go_on()
    levels(obj)
    while handlers._go_on() is not None:
        pass
    bpy.context.view_layer.update()
    assert not handlers._running
    assert_right(obj, armature, rng)
