# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights written, read and taken over in slices: the same as one by one, and never half done."""

from __future__ import annotations

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from gskin_addon import registration
from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.lbs import sparsify, top_influences
from gskin_addon.scene import handlers, influences, names, weights
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.binding import iter_prepare
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.steps import SLICE, part_of, run_for, run_to_end, slices
from gskin_addon.scene.vertex_groups import GroupsAside
from gskin_addon.scene.weights import (
    iter_read_weights,
    iter_update_rotation_weights,
    iter_write_weights,
    read_weights,
    update_rotation_weights,
    write_weights,
)

COUNT, BONES = 300, 6


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.fixture
def rig(rng):
    """Splats, armature, dense weights."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return scene_of(COUNT, rng)


def scene_of(count, rng):
    cloud = clouds.random_cloud(count, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(BONES, rng)
    return obj, armature, rigs.random_weights(cloud, BONES, rng)


def one_by_one(obj, bones):
    """(N, B) of the vertex groups by Blender's slowest way."""
    found = np.zeros((len(obj.data.vertices), len(bones)), np.float32)
    for vertex in obj.data.vertices:
        for element in vertex.groups:
            name = obj.vertex_groups[element.group].name
            if name in bones:
                found[vertex.index, bones.index(name)] = element.weight
    return found


def state(obj):
    """All that writing may change, and what it may leave behind."""
    attributes = {a.name: read_attribute(obj.data, a.name) for a in obj.data.attributes if a.name.startswith("gskin")}
    bones = [group.name for group in obj.vertex_groups]
    return {
        "groups": bones,
        "weights": one_by_one(obj, bones).tolist(),
        "attributes": {name: value.tolist() for name, value in attributes.items()},
        "modifiers": [m.name for m in obj.modifiers],
        "parent": obj.parent and obj.parent.name,
        "mesh": obj.data.name,
        "objects": sorted(o.name for o in bpy.data.objects),
        "meshes": sorted(m.name for m in bpy.data.meshes),
    }


# --- the same as one by one


@pytest.mark.parametrize("already_sparse", [True, False])
def test_groups_are_those_that_adding_each_value_makes(rig, already_sparse):
    obj, armature, dense = rig
    given = sparsify(dense, 3) if already_sparse else dense
    write_weights(obj, armature, given, max_influences=3)
    index, value = top_influences(given, 3)
    slow = obj.copy()
    slow.data = obj.data.copy()
    slow.vertex_groups.clear()
    bones = [bone.name for bone in armature.data.bones]
    for bone in bones:
        slow.vertex_groups.new(name=bone)
    for splat, (row, amounts) in enumerate(zip(index, value, strict=True)):
        for bone, amount in zip(row, amounts, strict=True):
            if amount > 0:
                slow.vertex_groups[int(bone)].add([splat], float(amount), "REPLACE")
    assert [group.name for group in obj.vertex_groups] == bones
    np.testing.assert_array_equal(one_by_one(obj, bones), one_by_one(slow, bones))
    np.testing.assert_array_equal(read_weights(obj)[0], one_by_one(obj, bones))
    stored = np.stack([read_attribute(obj.data, names.WEIGHT.format(slot)) for slot in range(3)], axis=1)
    places = np.stack([read_attribute(obj.data, names.BONE.format(slot)) for slot in range(3)], axis=1)
    np.testing.assert_array_equal(stored, value.astype(np.float32))
    np.testing.assert_array_equal(places, index)


def test_sparse_rows_are_not_sorted_again(rig, monkeypatch):
    obj, armature, dense = rig
    monkeypatch.setattr(influences, "top_influences", None)
    write_weights(obj, armature, sparsify(dense, 4))
    with pytest.raises(TypeError):
        write_weights(obj, armature, dense)


def test_equal_weights_are_stored_in_the_order_of_the_bones(rig):
    obj, armature, dense = rig
    for given in (np.tile(np.float32([0, 0.25, 0.25, 0, 0.25, 0.25]), (COUNT, 1)), np.full_like(dense, 1 / 6)):
        write_weights(obj, armature, given)
        places = np.stack([read_attribute(obj.data, names.BONE.format(slot)) for slot in range(4)], axis=1)
        assert (np.diff(places, axis=1) > 0).all()


def test_bones_with_the_names_of_attributes(rig, rng):
    obj, armature, dense = rig
    for bone, name in zip(armature.data.bones, ("position", "rotation", "scale", "x" * 63), strict=False):
        bone.name = name
    before = read_positions(obj.data), read_attribute(obj.data, "rotation")
    dense[:, 5] = 0
    write_weights(obj, armature, dense)
    bones = [bone.name for bone in armature.data.bones]
    assert [group.name for group in obj.vertex_groups] == bones  # the one without weights too
    np.testing.assert_array_equal(read_weights(obj)[0], one_by_one(obj, bones))
    np.testing.assert_array_equal(read_positions(obj.data), before[0])
    np.testing.assert_array_equal(read_attribute(obj.data, "rotation"), before[1])
    assert not [a.name for a in obj.data.attributes if "making" in a.name]


def test_the_new_mesh_is_all_that_the_old_one_was(rig):
    obj, armature, dense = rig
    twin = bpy.data.objects.new("Twin", obj.data)
    bpy.context.scene.collection.objects.link(twin)
    obj.data.materials.append(bpy.data.materials.new("Paper"))
    obj.data["note"] = "kept"
    obj.data.use_fake_user = True
    obj.shape_key_add(name="Basis")
    obj.shape_key_add(name="Wide").data[0].co.x = 9
    write_weights(obj, armature, dense)
    mesh = obj.data
    assert twin.data == mesh
    assert mesh.name == "S"
    assert mesh.materials[0].name == "Paper"
    assert mesh["note"] == "kept"
    assert mesh.use_fake_user
    assert mesh.shape_keys.user == mesh
    assert obj.active_shape_key.id_data.key_blocks["Wide"].data[0].co.x == 9
    assert len(bpy.data.shape_keys) == 1
    assert [m.name for m in bpy.data.meshes if m.name.startswith("S")] == ["S"]
    np.testing.assert_array_equal(one_by_one(twin, [g.name for g in obj.vertex_groups]), read_weights(obj)[0])


def test_while_another_object_is_edited(rig):
    obj, armature, dense = rig
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    write_weights(obj, armature, dense)
    assert armature.mode == "EDIT"
    bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_allclose(read_weights(obj)[0], sparsify(dense, 4), atol=1e-7)


def test_in_weight_paint(rig):
    obj, armature, dense = rig
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    write_weights(obj, armature, dense)
    assert obj.mode == "WEIGHT_PAINT"
    np.testing.assert_allclose(read_weights(obj)[0], sparsify(dense, 4), atol=1e-7)
    bpy.ops.object.mode_set(mode="OBJECT")


def test_no_slice_handles_more_than_so_many_splats(rng, monkeypatch):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    count = 2 * SLICE + 3
    obj, armature, dense = scene_of(count, rng)
    sizes = []
    kept = {name: getattr(weights, name) for name in ("read_pairs", "strongest")}

    def read(obj, part):
        sizes.append(part.stop - part.start)
        return kept["read_pairs"](obj, part)

    def strongest(rows, k):
        sizes.append(len(rows))
        return kept["strongest"](rows, k)

    monkeypatch.setattr(weights, "read_pairs", read)
    monkeypatch.setattr(weights, "strongest", strongest)
    for steps in (
        iter_write_weights(obj, armature, dense),
        iter_read_weights(obj, ["bone.001"]),
        iter_update_rotation_weights(obj),
    ):
        sizes.clear()
        shares, most = [], 0
        while True:
            before = len(sizes)
            try:
                shares.append(next(steps))
            except StopIteration:
                break
            most = max(most, *sizes[before:], 0)
        assert 0 < most <= SLICE
        assert len(shares) >= 3
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(1.0)
    np.testing.assert_array_equal(read_weights(obj)[0], one_by_one(obj, [b.name for b in armature.data.bones]))


def test_painted_weights_taken_over_in_slices(rig, monkeypatch):
    obj, armature, dense = rig
    write_weights(obj, armature, dense)
    obj.vertex_groups["bone.002"].add([*range(100)], 0.9, "REPLACE")
    for group in obj.vertex_groups:
        group.remove([7, 150])
    painted = one_by_one(obj, [b.name for b in armature.data.bones])
    monkeypatch.setattr(influences, "CELLS", 64 * BONES)
    update_rotation_weights(obj)
    index, value = top_influences(painted, 4)
    value[[7, 150]] = 0
    stored = np.stack([read_attribute(obj.data, names.WEIGHT.format(slot)) for slot in range(4)], axis=1)
    places = np.stack([read_attribute(obj.data, names.BONE.format(slot)) for slot in range(4)], axis=1)
    np.testing.assert_array_equal(stored[[7, 150]], [[1, 0, 0, 0]] * 2)
    value[[7, 150], 0] = 1
    index[[7, 150]] = -1
    np.testing.assert_array_equal(stored, value)
    np.testing.assert_array_equal(places, np.where((value > 0), index, -1))


# --- never half done


@pytest.mark.parametrize("written_before", [True, False])
def test_closed_after_any_slice_all_is_as_it_was(rig, written_before):
    obj, armature, dense = rig
    obj.vertex_groups.new(name="Mask").add([1, 2], 0.5, "REPLACE")
    if written_before:
        write_weights(obj, armature, dense[:, ::-1], confidence=np.full(COUNT, 0.5))
    before = state(obj)
    run_to_end(iter_prepare(armature))  # nodes that are built stay, and the next slices are fewer
    slices_in_all = len([*iter_write_weights(obj, armature, dense[:, ::-1], confidence=np.full(COUNT, 0.5))])
    if not written_before:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        obj, armature, dense = scene_of(COUNT, np.random.default_rng(11))
        obj.vertex_groups.new(name="Mask").add([1, 2], 0.5, "REPLACE")
        before = state(obj)
        run_to_end(iter_prepare(armature))
    for stop in range(1, slices_in_all + 1):
        steps = iter_write_weights(obj, armature, dense)
        for _ in range(stop):
            next(steps)
        steps.close()
        assert state(obj) == before, stop
    write_weights(obj, armature, dense)
    np.testing.assert_allclose(read_weights(obj)[0], sparsify(dense, 4), atol=1e-7)
    assert read_weights(obj, ["Mask"])[0].sum() == 1.0


def delete(obj, armature):
    bpy.data.objects.remove(obj)


def unlink(obj, armature):
    bpy.context.scene.collection.objects.unlink(obj)


def add_splats(obj, armature):
    obj.data.vertices.add(2)


def edit(obj, armature):
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="EDIT")


def delete_armature(obj, armature):
    bpy.data.objects.remove(armature)


def rename_bone(obj, armature):
    armature.data.bones[2].name = "other"


def stretch(obj, armature):
    obj.scale = (1, 2, 1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (delete, "'S' was deleted"),
        (unlink, "'S' was deleted"),
        (add_splats, "'S' was changed"),
        (edit, "'S' was changed"),
        (delete_armature, "'Rig' was deleted or changed"),
        (rename_bone, "'Rig' was deleted or changed"),
        (stretch, "'S' is scaled unevenly"),
    ],
)
def test_what_changes_meanwhile_is_named_and_nothing_is_written(rig, change, words):
    obj, armature, dense = rig
    before = state(obj)
    steps = iter_write_weights(obj, armature, dense)
    for _ in range(3):
        next(steps)
    change(obj, armature)
    with pytest.raises(InputError, match=words):
        run_to_end(steps)
    assert {o.name for o in bpy.data.objects} <= set(before["objects"])
    assert {m.name for m in bpy.data.meshes} <= set(before["meshes"])
    if change is not delete:
        assert not obj.vertex_groups
        assert not any(m.type == "ARMATURE" for m in obj.modifiers)
        if obj.mode == "EDIT":
            bpy.ops.object.mode_set(mode="OBJECT")


def test_an_undo_in_the_middle_leaves_nothing_half_written(rig):
    obj, armature, dense = rig
    bpy.ops.ed.undo_push(message="before")
    obj.location.x = 1
    bpy.ops.ed.undo_push(message="moved")
    steps = iter_write_weights(obj, armature, dense)
    for _ in range(4):
        next(steps)
    del obj, armature
    bpy.ops.ed.undo()
    with pytest.raises(InputError, match=r"undo|deleted"):
        run_to_end(steps)
    assert [o.name for o in bpy.data.objects if "Octahed" not in o.name] == ["Rig", "S"]
    assert not bpy.data.objects["S"].vertex_groups
    assert [m.name for m in bpy.data.meshes if "Octahed" not in m.name] == ["S"]


def test_reading_stops_where_groups_change_meanwhile(rig, monkeypatch):
    obj, armature, dense = rig
    write_weights(obj, armature, dense)
    monkeypatch.setattr(influences, "CELLS", 64 * BONES)
    steps = iter_update_rotation_weights(obj)
    next(steps)
    before = state(obj)
    obj.vertex_groups.remove(obj.vertex_groups[0])
    with pytest.raises(InputError, match="groups of 'S' were changed while they were read"):
        next(steps)
    assert state(obj)["attributes"] == before["attributes"]


def test_a_second_writer_finds_the_mesh_changed(rig):
    obj, armature, dense = rig
    with GroupsAside(obj) as groups:
        run_to_end(groups.write(["bone.000"], lambda bone: np.ones(COUNT, np.float32)))
        write_weights(obj, armature, dense)
        with pytest.raises(InputError, match="'S' was changed"):
            groups.commit()
    assert len(obj.vertex_groups) == BONES


# --- after Weight Paint, with a window


@pytest.fixture
def painted(rig, monkeypatch):
    """Bound splats, painted on, as left behind by Weight Paint in a window."""
    obj, armature, dense = rig
    write_weights(obj, armature, dense)
    monkeypatch.setattr(handlers, "_watched", lambda: True)
    monkeypatch.setattr(handlers, "BUDGET", 0.0)
    monkeypatch.setattr(influences, "CELLS", 64 * BONES)
    registration.register_module(handlers)
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    paint(obj)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    yield obj
    registration.unregister_module(handlers)


def paint(obj, bone="bone.001", amount=0.9):
    for group in obj.vertex_groups:
        group.remove([*range(COUNT)])
    obj.vertex_groups[bone].add([*range(COUNT)], amount, "REPLACE")
    obj.data.update()
    bpy.context.view_layer.update()


def turned_by(obj):
    return set(read_attribute(obj.data, names.BONE.format(0)).tolist())


def test_a_timer_takes_painted_weights_over(painted):
    assert bpy.app.timers.is_registered(handlers._go_on)
    calls = 1
    while handlers._go_on() is not None:
        assert turned_by(painted) != {1}
        calls += 1
    assert calls >= COUNT // 64
    assert turned_by(painted) == {1}


def test_painting_again_begins_anew(painted):
    handlers._go_on()
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    paint(painted, "bone.003")
    assert not handlers._running
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    while handlers._go_on() is not None:
        pass
    assert turned_by(painted) == {3}


def test_an_operator_goes_on_with_what_the_timer_began(painted):
    handlers._go_on()
    steps, shares = handlers.iter_settle(painted), []
    for share in steps:
        assert turned_by(painted) != {1}
        shares.append(share)
    assert len(shares) >= COUNT // 64 - 1
    assert turned_by(painted) == {1}
    assert not handlers.is_unsettled(painted)
    assert handlers._go_on() is None


def test_the_timer_goes_on_with_what_an_operator_gives_up(painted):
    steps = handlers.iter_settle(painted)
    next(steps)
    steps.close()
    assert handlers.is_unsettled(painted)
    while handlers._go_on() is not None:
        pass
    assert turned_by(painted) == {1}


def test_saving_waits_for_it(painted, tmp_path):
    handlers._go_on()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "s.blend"))
    assert turned_by(painted) == {1}
    assert handlers._go_on() is None


def test_deleting_the_splats_meanwhile_ends_it(painted, capsys):
    handlers._go_on()
    bpy.data.objects.remove(painted)
    assert handlers._go_on() is None
    assert "'S' was deleted" in capsys.readouterr().out


# --- the slices themselves


def test_steps():
    def work():
        yield 0.5
        yield 1.0
        return "done"

    assert run_to_end(work()) == "done"
    assert run_for(work(), 0.0) == 0.5
    whole = work()
    with pytest.raises(StopIteration) as stop:
        run_for(whole, 60.0)
    assert stop.value.value == "done"
    assert [*part_of(work(), 0.2, 0.4)] == pytest.approx([0.3, 0.4])
    assert [(s.start, s.stop) for s in slices(5, 2)] == [(0, 2), (2, 4), (4, 5)]
    assert [*slices(0)] == []


def test_closing_a_part_closes_the_work():
    closed = []

    def work():
        try:
            yield 0.5
        finally:
            closed.append(True)

    steps = part_of(work(), 0, 1)
    next(steps)
    steps.close()
    assert closed
