# SPDX-License-Identifier: GPL-3.0-or-later
"""The import operator, and weights from files."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.core.rig.weights_file import write_weights_file
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.formats import FILE_TYPES, FORMATS, read_splats
from gskin_addon.core.splats.ply import write_ply
from gskin_addon.core.splats.sog_write import write_sog
from gskin_addon.core.splats.spz import write_spz
from gskin_addon.scene.armature import read_skeleton
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.fabric import has_fabric
from gskin_addon.scene.gltf_export import export_glb
from gskin_addon.scene.import_file import ImportOptions, import_steps
from gskin_addon.scene.placement import up_of
from gskin_addon.scene.rotation_nodes import frames_of
from gskin_addon.scene.splat_object import create_splat_object, is_splat_object, read_cloud
from gskin_addon.scene.weights import read_weights, write_weights


@pytest.fixture(autouse=True)
def registered():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    yield
    gskin_addon.unregister()


def save(tmp_path, name="vase.ply", count=30, degree=1):
    cloud = clouds.random_cloud(count, degree)
    write_ply(tmp_path / name, cloud)
    return cloud


def test_import_makes_the_active_object(tmp_path):
    cloud = save(tmp_path)
    assert bpy.ops.gskin.import_splats(filepath=str(tmp_path / "vase.ply")) == {"FINISHED"}
    obj = bpy.context.view_layer.objects.active
    assert is_splat_object(obj)
    assert obj.name == "vase"
    assert obj.select_get()
    np.testing.assert_array_equal(read_cloud(obj).means, cloud.means)
    assert bpy.context.scene.cycles.transparent_max_bounces >= 256


def test_up_axis(tmp_path):
    cloud = save(tmp_path)
    bpy.ops.gskin.import_splats(filepath=str(tmp_path / "vase.ply"), up="-y")
    means = read_cloud(bpy.context.view_layer.objects.active).means
    np.testing.assert_allclose(means, cloud.means[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)


def test_several_files_of_which_one_is_bad(tmp_path):
    save(tmp_path, "a.ply")
    save(tmp_path, "b.ply")
    (tmp_path / "bad.ply").write_text("not a ply")
    files = [{"name": name} for name in ("a.ply", "bad.ply", "b.ply")]
    with pytest.raises(RuntimeError, match=r"bad\.ply"):
        bpy.ops.gskin.import_splats(directory=str(tmp_path), files=files)
    assert {o.name for o in bpy.context.selected_objects} == {"a", "b"}


def test_errors_are_reported_and_nothing_is_made(tmp_path):
    with pytest.raises(RuntimeError, match="missing"):
        bpy.ops.gskin.import_splats(filepath=str(tmp_path / "missing.ply"))
    assert not bpy.data.objects
    assert not bpy.data.meshes


def test_invalid_splats(tmp_path):
    cloud = clouds.random_cloud(10, 0)
    cloud.means[3] = np.nan
    write_ply(tmp_path / "nan.ply", cloud)
    with pytest.raises(RuntimeError, match=r"nan\.ply"):
        bpy.ops.gskin.import_splats(filepath=str(tmp_path / "nan.ply"))
    bpy.ops.gskin.import_splats(filepath=str(tmp_path / "nan.ply"), drop_invalid=True)
    assert read_cloud(bpy.context.view_layer.objects.active).count == 9


def test_dropped_files_find_the_operator():
    handler = bpy.types.FileHandler.bl_rna_get_subclass_py("GSKIN_FH_splats")
    assert handler.bl_import_operator == "gskin.import_splats"
    assert set(handler.bl_file_extensions.split(";")) == set(FILE_TYPES)


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_every_format_becomes_an_object(tmp_path, name):
    """Also .sog, whose images Blender decodes: Pillow is hidden."""
    form = FORMATS[name]
    cloud = clouds.random_cloud(300, 2)
    path = tmp_path / f"vase{form.suffixes[0]}"
    form.write(path, cloud)
    wanted = read_splats(path).cloud
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "PIL", None)
        assert bpy.ops.gskin.import_splats(filepath=str(path), up="z") == {"FINISHED"}
    obj = bpy.context.view_layer.objects.active
    assert obj.name == "vase"
    found = read_cloud(obj)
    np.testing.assert_array_equal(found.means, wanted.means)
    np.testing.assert_array_equal(found.sh, wanted.sh)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=1e-7)
    assert not bpy.data.images


def test_a_folder_of_a_sog_is_chosen_by_its_meta_json(tmp_path):
    folder = tmp_path / "vase"
    folder.mkdir()
    write_sog(folder / "meta.json", clouds.random_cloud(40, 1))
    assert bpy.ops.gskin.import_splats(filepath=str(folder / "meta.json")) == {"FINISHED"}
    assert bpy.context.view_layer.objects.active.name == "vase"


def test_guess_goes_by_the_format_where_splats_do_not_tell(tmp_path, capfd):
    write_spz(tmp_path / "ball.spz", clouds.random_cloud(300, 1))
    bpy.ops.gskin.import_splats(filepath=str(tmp_path / "ball.spz"))
    assert "assumed Y up, as its format says" in capfd.readouterr().out
    assert up_of(bpy.context.view_layer.objects.active) == "y"


def test_import_in_slices_is_the_import_at_once(tmp_path):
    """Every slice is a small part of the work; what is made is the same as from `rotate_cloud`."""
    cloud = clouds.random_cloud(70_000, 1)
    write_ply(tmp_path / "a.ply", cloud)
    steps = import_steps(tmp_path / "a.ply", ImportOptions("y"), None, bpy.context.scene, bpy.context.collection)
    shares = []
    while True:
        try:
            shares.append(next(steps))
        except StopIteration as stop:
            obj = stop.value.object
            break
    assert shares == sorted(shares)
    assert len(shares) > 20
    wanted, found = rotate_cloud(cloud, up_rotation("y")), read_cloud(obj)
    np.testing.assert_array_equal(found.means, wanted.means)
    np.testing.assert_allclose(found.quats, wanted.quats, atol=1e-7)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-6)


@pytest.mark.parametrize("after", [1, 8, 12, 20])
def test_an_import_that_ends_early_leaves_nothing(tmp_path, after):
    write_ply(tmp_path / "a.ply", clouds.random_cloud(70_000, 1))
    steps = import_steps(tmp_path / "a.ply", ImportOptions("y"), None, bpy.context.scene, bpy.context.collection)
    for _ in range(after):
        next(steps)
    steps.close()
    assert not bpy.data.meshes
    assert not bpy.data.objects


@pytest.fixture
def rig():
    rng = np.random.default_rng(3)
    cloud = clouds.random_cloud(60, 0)
    obj, armature = create_splat_object(cloud, "S"), rigs.make_chains(5, rng)
    armature.select_set(True)
    bpy.context.view_layer.objects.active = obj
    return obj, armature, rigs.random_weights(cloud, 5, rng), rng


def test_a_rigged_glb_comes_back_at_rest(rig, tmp_path):
    """Splats, rotations and harmonics, whatever the pose and wherever the armature stands."""
    obj, armature, weights, rng = rig
    write_weights(obj, armature, weights)
    armature.location = 1.0, 2.0, 3.0
    bpy.context.view_layer.update()
    wanted = read_cloud(obj)
    rigs.random_pose(armature, rng)
    export_glb(tmp_path / "rigged.glb", [obj])
    loaded = read_splats(tmp_path / "rigged.glb").cloud
    found = rotate_cloud(loaded, up_rotation(loaded.up))
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    np.testing.assert_allclose(found.scales, wanted.scales, rtol=1e-5)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-5)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", found.quats, wanted.quats)), 1.0, atol=1e-5)


def test_load_weights(rig, tmp_path):
    obj, armature, weights, rng = rig
    write_weights_file(tmp_path / "w.npz", weights, read_skeleton(armature))
    assert bpy.ops.gskin.load_weights(filepath=str(tmp_path / "w.npz")) == {"FINISHED"}
    np.testing.assert_allclose(read_weights(obj)[0], sparsify(weights, 4), atol=1e-6)
    assert has_fabric(obj)
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


@pytest.mark.parametrize("wanted", [True, False])
def test_binding_lays_a_fabric_if_that_is_wanted(rig, wanted):
    """As Auto-Skin does; until now only Make Paintable did."""
    obj, armature, _, rng = rig
    bpy.context.scene.gskin.paintable = wanted
    for bone in armature.data.bones:
        obj.vertex_groups.new(name=bone.name).add(list(range(60)), rng.uniform(0.1, 1.0), "REPLACE")
    assert bpy.ops.gskin.bind_to_armature() == {"FINISHED"}
    assert has_fabric(obj) == wanted


def test_weights_leave_and_come_back_as_rignets_text(rig, tmp_path):
    """Bones whose names have spaces, which such a file has not."""
    obj, armature, weights, _ = rig
    armature.data.bones[1].name = "upper arm"
    write_weights(obj, armature, weights)
    before = read_weights(obj)[0]
    assert bpy.ops.gskin.save_weights(filepath=str(tmp_path / "w.txt"), kind="RIGNET") == {"FINISHED"}
    assert "upper_arm" in (tmp_path / "w.txt").read_text()
    write_weights(obj, armature, weights[:, ::-1])
    assert bpy.ops.gskin.load_weights(filepath=str(tmp_path / "w.txt")) == {"FINISHED"}
    np.testing.assert_allclose(read_weights(obj)[0], before, atol=1e-5)


def test_load_weights_of_other_splats(rig, tmp_path):
    obj, armature, weights, _ = rig
    write_weights_file(tmp_path / "w.npz", weights[:-1], read_skeleton(armature))
    with pytest.raises(RuntimeError, match="'S' has 60 splats"):
        bpy.ops.gskin.load_weights(filepath=str(tmp_path / "w.npz"))
    assert not obj.vertex_groups


def test_bind_with_groups_that_are_there(rig):
    obj, armature, _, rng = rig
    for bone in armature.data.bones[1:]:  # four: splats that more bones move turn with the four strongest
        obj.vertex_groups.new(name=bone.name).add(list(range(60)), rng.uniform(0.1, 1.0), "REPLACE")
    assert bpy.ops.gskin.bind_to_armature() == {"FINISHED"}
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_bind_without_weights_does_not_say_that_splats_follow(rig, capfd):
    obj, armature, _, _ = rig
    assert bpy.ops.gskin.bind_to_armature() == {"FINISHED"}
    assert "60 of 60 splats have no weights for bones of 'Rig' and stay" in capfd.readouterr().out
    for bone in armature.data.bones:
        obj.vertex_groups.new(name=bone.name).add([*range(50)], 0.5, "REPLACE")
    bpy.ops.gskin.bind_to_armature()
    assert "10 of 60 splats" in capfd.readouterr().out


def test_bind_says_what_is_missing(rig):
    _, armature, _, _ = rig
    bpy.data.objects.remove(armature)
    with pytest.raises(RuntimeError, match="armature"):
        bpy.ops.gskin.bind_to_armature()


def test_leaving_weight_paint_takes_the_weights_over(rig):
    obj, armature, weights, rng = rig
    write_weights(obj, armature, weights)
    bpy.context.view_layer.update()
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
    half = list(range(0, 60, 2))
    for group in obj.vertex_groups:
        group.remove(half)
    obj.vertex_groups["bone.001"].add(half, 0.4, "REPLACE")
    obj.data.update()
    bpy.context.view_layer.update()
    before = read_attribute(obj.data, "gskin:bone_0")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    after = read_attribute(obj.data, "gskin:bone_0")
    assert not (before[half] == 1).all()
    assert (after[half] == 1).all()
    rigs.random_pose(armature, rng)
    rigs.assert_same_pose(obj, armature)


def test_copies_of_splats_and_armature_follow_their_own(rig):
    obj, armature, weights, rng = rig
    write_weights(obj, armature, weights)
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    armature.select_set(True)
    bpy.ops.object.duplicate()
    bpy.context.view_layer.update()
    copy, own = bpy.data.objects["S.001"], bpy.data.objects["Rig.001"]
    assert armature_of(frames_of(copy)) == own == armature_of(copy)
    rigs.random_pose(own, rng)
    rigs.assert_same_pose(copy, own)
    rigs.assert_same_pose(obj, armature)


def test_one_undo_step(rig, tmp_path):
    _, armature, weights, _ = rig
    write_weights_file(tmp_path / "w.npz", weights, read_skeleton(armature))
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.gskin.load_weights(filepath=str(tmp_path / "w.npz"))
    assert len(bpy.data.objects["S"].vertex_groups) == 5
    # From a script operators push no step of their own; the user interface pushes exactly one.
    bpy.ops.ed.undo_push(message="Load Splat Weights")
    bpy.ops.ed.undo()
    back = bpy.data.objects["S"]
    assert not back.vertex_groups
    assert back.parent is None
    assert [m.name for m in back.modifiers] == ["GSkin Display"]
    assert frames_of(back) is None
