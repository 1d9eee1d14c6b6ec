# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare Weights: before learning and after, switched on the posed figure, and nothing painted is lost."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import pretend
import worker_jobs as jobs

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.influences import Influences
from gskin_addon.core.rig.weights_file import write_weights_file
from gskin_addon.scene import names
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.attributes import read_attribute, read_positions
from gskin_addon.scene.cleanup import remove_splats
from gskin_addon.scene.compared import compared, is_edited, is_kept_edited, show_side
from gskin_addon.scene.given_weights import YOURS, iter_give_weights
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.steps import run_to_end
from gskin_addon.scene.weights import read_weights, update_rotation_weights, write_weights

COUNT = 300
RNG = np.random.default_rng(3)


def random_weights() -> np.ndarray:
    weights = RNG.uniform(0.01, 1, (COUNT, 2)).astype(np.float32)
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    with pretend.session(tmp_path, monkeypatch) as scene:
        yield scene


@pytest.fixture
def armature(scene):
    return pretend.add_armature()


@pytest.fixture
def splats(scene, armature):
    """Splats with a result to compare with its start."""
    obj = create_splat_object(jobs.rod(COUNT)[0], "Rod", display=False)
    start = Influences.strongest(random_weights())
    sure = np.linspace(0, 1, COUNT, dtype=np.float32)
    write_weights(obj, armature, random_weights(), confidence=sure, start=("bone heat", start))
    scene.gskin.splats = obj
    bpy.context.view_layer.update()
    return obj


def groups_of(obj) -> list[dict[str, float]]:
    """Per splat: every membership, with its weight."""
    return [{obj.vertex_groups[g.group].name: g.weight for g in vertex.groups} for vertex in obj.data.vertices]


def turning(obj) -> np.ndarray:
    slots = range(names.INFLUENCES)
    kinds = (names.BONE, names.WEIGHT)
    return np.stack([read_attribute(obj.data, kind.format(slot)) for slot in slots for kind in kinds])


def posed(obj) -> np.ndarray:
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return read_positions(obj.evaluated_get(depsgraph).data).copy()


def test_the_two_sides_pose_the_splats(splats, armature):
    start = read_attribute(splats.data, names.KEPT_WEIGHT.format(0)).copy()
    armature.pose.bones["upper"].rotation_mode = "XYZ"
    armature.pose.bones["upper"].rotation_euler.x = 1.0
    bpy.context.view_layer.update()
    learned = posed(splats)
    assert compared(splats) == ("bone heat", "result")
    assert bpy.ops.gskin.compare_weights(show="BEFORE") == {"FINISHED"}
    assert compared(splats) == ("bone heat", "before")
    np.testing.assert_array_equal(read_weights(splats)[0].max(axis=1), start)
    bpy.context.view_layer.update()
    assert np.abs(posed(splats) - learned).max() > 0.1
    assert bpy.ops.gskin.compare_weights() == {"FINISHED"}
    assert compared(splats) == ("bone heat", "result")
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(posed(splats), learned)


def test_what_is_painted_on_either_side_stays_to_the_bit(splats, armature):
    # More bones than influences, weights that do not sum to 1, a splat without any, a group of the artist's own.
    upper, mine = splats.vertex_groups["upper"], splats.vertex_groups.new(name="Mine")
    upper.add([0, 1], 0.123, "REPLACE")
    upper.lock_weight = True
    for name in ("lower", "upper"):
        splats.vertex_groups[name].remove([5])
    mine.add([0, 7], 0.7, "REPLACE")
    splats.vertex_groups.active_index = splats.vertex_groups.find("upper")
    result, sure = groups_of(splats), read_attribute(splats.data, names.CONFIDENCE).copy()
    update_rotation_weights(splats)
    turn = turning(splats)
    show_side(splats, "before")
    assert groups_of(splats)[7]["Mine"] == pytest.approx(0.7)
    splats.vertex_groups["lower"].add([9], 0.321, "REPLACE")
    before = groups_of(splats)
    assert before != result
    show_side(splats, "result")
    assert groups_of(splats) == result
    np.testing.assert_array_equal(turning(splats), turn)
    np.testing.assert_array_equal(read_attribute(splats.data, names.CONFIDENCE), sure)
    assert splats.vertex_groups["upper"].lock_weight
    assert splats.vertex_groups.active.name == "upper"
    show_side(splats, "before")
    assert groups_of(splats) == before
    show_side(splats, "before")
    assert groups_of(splats) == before


def test_weights_of_many_bones_come_back_whole(scene):
    bones = [(f"b{i}", (0, 0, i / 4), (0, 0, (i + 1) / 4)) for i in range(8)]
    armature = pretend.add_armature(bones, "Many")
    obj = create_splat_object(jobs.rod(COUNT)[0], "Rod", display=False)
    weights = RNG.dirichlet(np.ones(8), COUNT).astype(np.float32)
    write_weights(obj, armature, weights, start=("bone heat", Influences.strongest(weights[::-1].copy())))
    for bone in range(8):
        obj.vertex_groups[f"b{bone}"].add([3], 0.1 * bone + 0.05, "REPLACE")
    painted = groups_of(obj)
    assert len(painted[3]) == 8
    show_side(obj, "before")
    assert len(groups_of(obj)[3]) <= 4
    show_side(obj, "result")
    assert groups_of(obj) == painted


def test_splats_that_go_take_both_sides_along(splats):
    show_side(splats, "before")
    before = groups_of(splats)
    gone = np.arange(COUNT) % 3 == 0
    show_side(splats, "result")
    result = groups_of(splats)
    remove_splats(splats, gone)
    assert groups_of(splats) == [row for row, away in zip(result, gone, strict=True) if not away]
    show_side(splats, "before")
    assert groups_of(splats) == [row for row, away in zip(before, gone, strict=True) if not away]


def test_a_saved_file_has_both(splats, tmp_path):
    result = groups_of(splats)
    show_side(splats, "before")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rod.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "rod.blend"))
    obj = bpy.data.objects["Rod"]
    assert compared(obj) == ("bone heat", "before")
    show_side(obj, "result")
    assert groups_of(obj) == result


def test_undo_brings_the_side_back(splats):
    bpy.ops.ed.undo_push(message="learned")
    bpy.ops.gskin.compare_weights(show="BEFORE")
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.ed.undo()
    assert compared(bpy.data.objects["Rod"]) == ("bone heat", "result")


def test_a_bone_that_is_gone_keeps_the_switch_from_losing_it(splats, armature):
    armature.data.bones["upper"].name = "Renamed"
    before = groups_of(splats)
    with pytest.raises(InputError, match="for bone 'upper'"):
        show_side(splats, "before")
    with pytest.raises(RuntimeError, match="give it back its name"):
        bpy.ops.gskin.compare_weights()
    assert groups_of(splats) == before
    armature.data.bones["Renamed"].name = "upper"
    show_side(splats, "before")


def test_blending_with_weights_of_a_bone_that_is_gone_is_refused(splats, armature):
    armature.data.bones["upper"].name = "Renamed"
    before = groups_of(splats)
    with pytest.raises(RuntimeError, match="for bone 'upper'"):
        bpy.ops.gskin.blend_weights(factor=0.5)
    assert groups_of(splats) == before


def test_hand_work_is_kept_whichever_side_is_shown_when_others_come(splats, armature):
    """An artist corrects the result, looks at what was before, and runs Auto-Skin again."""
    splats.vertex_groups["upper"].add(list(range(40)), 0.25, "REPLACE")
    bpy.context.view_layer.update()
    mine = read_weights(splats)[0]
    assert (is_edited(splats), is_kept_edited(splats)) == (True, False)
    bpy.ops.gskin.compare_weights(show="BEFORE")
    assert (is_edited(splats), is_kept_edited(splats)) == (False, True)
    for _ in range(2):  # nor do further runs lose it
        run_to_end(iter_give_weights(splats, armature, random_weights(), ["lower", "upper"]))
        assert compared(splats) == (YOURS, "result")
        assert (is_edited(splats), is_kept_edited(splats)) == (False, True)
    bpy.ops.gskin.compare_weights(show="BEFORE")
    assert np.array_equal(read_weights(splats)[0], mine)


def test_hand_work_for_a_renamed_bone_keeps_no_job_from_ending(splats, armature):
    splats.vertex_groups["upper"].add(list(range(40)), 0.25, "REPLACE")
    bpy.context.view_layer.update()
    mine = read_weights(splats)[0]
    bpy.ops.gskin.compare_weights(show="BEFORE")
    armature.data.bones["upper"].name = "Renamed"
    run_to_end(iter_give_weights(splats, armature, random_weights(), ["lower", "Renamed"]))
    armature.data.bones["Renamed"].name = "upper"
    bpy.ops.gskin.compare_weights(show="BEFORE")
    assert np.array_equal(read_weights(splats)[0], mine)


def test_hand_work_and_locks_outlast_weights_from_a_file(splats, armature, tmp_path):
    write_weights_file(tmp_path / "w.npz", random_weights(), read_skeleton(armature))
    bpy.context.scene.gskin.armature = armature
    splats.vertex_groups["upper"].add(list(range(40)), 0.25, "REPLACE")
    bpy.context.view_layer.update()
    mine = read_weights(splats)[0]
    assert bpy.ops.gskin.load_weights(filepath=str(tmp_path / "w.npz")) == {"FINISHED"}
    loaded = read_weights(splats)[0]
    assert not np.allclose(loaded, mine, atol=0.01)
    bpy.ops.gskin.compare_weights(show="BEFORE")
    assert np.array_equal(read_weights(splats)[0], mine)
    splats.vertex_groups["upper"].lock_weight = True
    assert bpy.ops.gskin.load_weights(filepath=str(tmp_path / "w.npz")) == {"FINISHED"}
    assert splats.vertex_groups["upper"].lock_weight
    assert np.array_equal(read_weights(splats)[0][:, 1], mine[:, 1])


def test_other_weights_have_nothing_to_compare_with(splats, armature):
    show_side(splats, "before")
    write_weights(splats, armature, random_weights())
    assert compared(splats) is None
    assert not [name for name in splats.data.attributes if "kept" in name.name]
    assert not bpy.ops.gskin.compare_weights.poll()
    with pytest.raises(RuntimeError, match="learned weights"):
        bpy.ops.gskin.compare_weights()
    with pytest.raises(InputError, match="no weights to compare"):
        show_side(splats, "result")


def test_edit_mode_says_so(splats):
    bpy.context.view_layer.objects.active = splats
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(RuntimeError, match="Leave Edit Mode"):
        bpy.ops.gskin.compare_weights()
    bpy.ops.object.mode_set(mode="OBJECT")


def test_auto_skin_leaves_what_it_started_from(scene, armature, monkeypatch):
    monkeypatch.setenv("GSKIN_TEST_ACT", "heights")
    scene.gskin.splats, scene.gskin.armature = create_splat_object(jobs.rod(COUNT)[0], "Rod"), armature
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    obj = scene.gskin.splats
    assert compared(obj) == ("bone heat", "result")
    bpy.ops.gskin.compare_weights(show="BEFORE")
    np.testing.assert_allclose(read_weights(obj)[0], 0.5)
