# SPDX-License-Identifier: GPL-3.0-or-later
"""The small cases of ../shared/cases that are about rigs and actions, each with the value that is right.

Skipped where they are not there; the same kinds, made up, are in the modules beside this one.
"""

from __future__ import annotations

import bpy
import figure_rig as fig
import numpy as np
import pytest
from figure_files import CASES
from glb import Glb

from gskin_addon.core.splats.ply import read_ply

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="no shared cases")


def rig(folder, name, out, *arguments):
    given = ("--armature", CASES / folder / name, "--out", out, "--progress", "none")
    assert fig.run("rig", CASES / folder / "fig.ply", *given, *arguments) == 0
    return out


def rest(folder):
    return read_ply(CASES / folder / "fig.ply").cloud.means


def hand_of(path, armature="Rig"):
    """Where hand.L ends in the world, in the file as it opens."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.context.view_layer.update()
    obj = bpy.context.scene.objects[armature]
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array(evaluated.matrix_world @ evaluated.pose.bones["hand.L"].tail)


TURNED = np.array([0.1, 0, 1.0]) + 0.7 * np.array([np.cos(np.pi / 3), 0, np.sin(np.pi / 3)])
"""Where hand.L ends when arm.L is turned by -60 degrees about y at the shoulder."""


@pytest.mark.parametrize(("folder", "name"), [("rest_position", "rest.blend"), ("nla_rotate", "nla.blend")])
def test_a_turn_arrives_and_stays(folder, name, tmp_path):
    rigged = rig(folder, name, tmp_path / "rigged.blend")
    assert fig.run("pose", rigged, "--out", tmp_path / "out.blend", *fig.TURN) == 0
    # The shoulder is where the file has it.
    shoulder = np.array(bpy.context.scene.objects["Rig"].data.bones["arm.L"].head_local)
    np.testing.assert_allclose(hand_of(tmp_path / "out.blend"), TURNED - [0.1, 0, 1.0] + shoulder, atol=0.06)
    assert np.abs(fig.posed_means(tmp_path / "out.blend") - rest(folder)).max() > 0.4


@pytest.mark.parametrize(("name", "hand"), [("pole.blend", (0.726, 0, 1.313)), ("driver.blend", (0.478, 0, 1.589))])
def test_the_arm_stands_where_it_stands_in_its_file(name, hand, tmp_path, capfd):
    np.testing.assert_allclose(hand_of(CASES / "ik_pole" / name), hand, atol=1e-3)
    rigged = rig("ik_pole", name, tmp_path / "rigged.blend")
    np.testing.assert_allclose(hand_of(rigged), hand, atol=1e-3)
    assert fig.run("pose", rigged, "--out", tmp_path / "out.ply", *fig.TURN) == 2
    assert "'arm.L' of 'Rig' cannot be turned" in capfd.readouterr().err


@pytest.mark.parametrize("out", ["out.blend", "out.glb"])
def test_a_rig_that_cannot_be_selected(out, tmp_path):
    path = rig("hidden_rig", "unselectable.blend", tmp_path / out)
    if path.suffix == ".glb":
        assert Glb(path).node("hand.L") >= 0


def test_an_override_is_chosen_and_becomes_the_files_own(tmp_path):
    rigged = rig("linked_rig", "shots/override.blend", tmp_path / "rigged.blend")
    bpy.ops.wm.open_mainfile(filepath=str(rigged))
    assert not bpy.data.libraries
    assert [obj.name for obj in bpy.data.objects if obj.type == "ARMATURE"] == ["Rig"]
    assert [action.name for action in bpy.data.actions] == ["Shot010"]
    assert np.abs(fig.posed_means(rigged, "--action", "Shot010", "--frame", 10) - rest("linked_rig")).max() > 0.1


@pytest.mark.skipif(not hasattr(bpy.types, "ActionSlot"), reason="slots are Blender 4.4's")
def test_heros_slot_moves_hero(tmp_path):
    rigged = rig("slots", "renamed.blend", tmp_path / "rigged.blend", "--armature-name", "Hero")
    assert np.abs(fig.posed_means(rigged, "--action", "Attack", "--frame", 10) - rest("slots")).max() > 0.3
    assert bpy.data.objects["Hero"].animation_data.action_slot.name_display == "Rig"


def test_only_heros_clips(tmp_path, capfd):
    rigged = rig("others_actions", "two.blend", tmp_path / "rigged.blend", "--armature-name", "Hero")
    for name in ("CameraMove", "MonsterRoar"):
        assert fig.run("pose", rigged, "--out", tmp_path / "out.ply", "--action", name) == 2
        assert f"no action '{name}'" in capfd.readouterr().err
    assert fig.run("pose", rigged, "--out", tmp_path / "out.glb") == 0
    assert [clip["name"] for clip in Glb(tmp_path / "out.glb").json["animations"]] == ["HeroWave"]
