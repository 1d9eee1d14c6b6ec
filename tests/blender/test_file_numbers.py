# SPDX-License-Identifier: GPL-3.0-or-later
"""From a file through rig, .blend and pose back to a file: coordinates, axes, opacities, sizes and further columns."""

from __future__ import annotations

import functools
import sys

import bpy
import figure_files as figures
import numpy as np
import pytest
import splat_clouds as clouds
import worker_jobs as jobs

from gskin_addon import cli
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.formats import read_splats
from gskin_addon.core.worker.client import WorkerClient
from gskin_addon.scene import placement
from gskin_addon.scene.rig_files import find_splats, open_blend
from gskin_addon.session import skin_job

UTM = (448252.0, 5411943.5, 32.0)


@pytest.fixture(autouse=True)
def pretended(monkeypatch):
    """Jobs that give every splat to the first bone, at once."""
    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    monkeypatch.setattr(skin_job, "WorkerClient", functools.partial(WorkerClient, program=jobs.FAKE))


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def there_and_back(tmp_path, splats, rig, *rig_options, pose_options=()) -> dict[str, np.ndarray]:
    """Columns of the .ply that `gskin pose` writes of what `gskin rig` made of the file, at rest."""
    assert run("rig", splats, "--armature", rig, "--out", tmp_path / "r.blend", "--progress", "none", *rig_options) == 0
    assert run("pose", tmp_path / "r.blend", "--out", tmp_path / "back.ply", *pose_options) == 0
    return clouds.read_columns(tmp_path / "back.ply")


def inputs(tmp_path, case, columns, rig="rig.blend", **rig_options):
    """Files of one of the shared cases (skipped where there are none), or of made-up columns and the figure's rig."""
    if isinstance(case, str):
        folder = figures.CASES / case.split("/")[0]
        if not folder.is_dir():
            pytest.skip(f"no {folder}")
        return figures.CASES / case, folder / rig
    path = clouds.write_columns(tmp_path / "fig.ply", columns)
    return path, figures.rig_file(tmp_path / "rig.blend", **rig_options)


def far(order=(0, 1, 2)) -> dict[str, np.ndarray]:
    columns = figures.figure()
    for name, place in zip("xyz", np.array(UTM)[list(order)], strict=True):
        columns[name] = columns[name].astype(np.float64) + place
    return columns


@pytest.mark.parametrize("case", ["georef/utm_double.ply", None])
def test_geo_referenced_splats_come_back_where_they_were(tmp_path, case, capsys):
    splats, rig = inputs(tmp_path, case, far(), "there.blend", location=UTM)
    before = clouds.read_columns(splats)
    after = there_and_back(tmp_path, splats, rig)
    for name in "xyz":
        assert after[name].dtype == np.float64
        np.testing.assert_allclose(after[name], before[name], rtol=0, atol=2e-7)
    words = capsys.readouterr().err
    assert "moved by (-448252" in words
    assert "was moved with them" in words
    open_blend(tmp_path / "r.blend")
    obj = find_splats(tmp_path / "r.blend")
    assert np.abs(np.array([v.co for v in obj.data.vertices])).max() < 2.0
    assert np.abs(bpy.data.objects["Rig"].matrix_world.translation).max() < 2.0


def test_a_rig_at_the_origin_fits_geo_referenced_splats_too(tmp_path):
    columns = far()
    columns["y"] += 0.5  # so that the middle is a whole number away
    splats, rig = inputs(tmp_path, None, columns, location=(0, 0, -1))
    before, after = clouds.read_columns(splats), there_and_back(tmp_path, splats, rig)
    np.testing.assert_allclose(after["y"], before["y"], rtol=0, atol=2e-7)
    assert tuple(bpy.data.objects["Rig"].location) == (0, 0, -1)


def test_geo_referenced_splats_that_were_placed_or_turned_go_back(tmp_path):
    columns = far()
    columns["y"], columns["z"] = -columns["z"], columns["y"]
    splats, rig = inputs(tmp_path, None, columns, location=UTM)
    before, after = clouds.read_columns(splats), there_and_back(tmp_path, splats, rig, "--ply-up=-y")
    for name in "xyz":
        np.testing.assert_allclose(after[name], before[name], rtol=0, atol=2e-7)
    import gskin_addon

    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    try:
        bpy.ops.gskin.import_splats(filepath=str(splats), place=True, up="z")
        obj = bpy.context.object
        placement.turn_up(obj, "-y")
        assert placement.is_placed(obj)
        back = placement.as_in_file(obj, placement.read_cloud(obj))
    finally:
        gskin_addon.unregister()
    for axis, name in enumerate("xyz"):
        place = back.means[:, axis].astype(np.float64) + back.offset[axis]
        np.testing.assert_allclose(place, before[name], rtol=0, atol=2e-6)


@pytest.mark.parametrize("case", ["extra_columns/extra.ply", None])
def test_further_columns_keep_type_and_value(tmp_path, case):
    columns, rng = figures.figure(), np.random.default_rng(3)
    for code in ("u1", "i1", "u2", "i2", "u4", "i4"):
        limits = np.iinfo(code)
        columns[code] = rng.integers(limits.min, limits.max, 900, code, endpoint=True)
        columns[code][:2] = limits.min, limits.max
    columns["time"] = 1.7e9 + rng.uniform(0, 1, 900)
    columns["time"][:3] = np.nan, -np.inf, 5e-324
    columns["small"] = rng.normal(size=900).astype(np.float32)
    splats, rig = inputs(tmp_path, case, columns)
    before, after = clouds.read_columns(splats), there_and_back(tmp_path, splats, rig)
    for name in set(before) - set("xyz") - {f"rot_{k}" for k in range(4)}:
        assert after[name].dtype == before[name].dtype, name
        if name not in figures.figure():
            np.testing.assert_array_equal(after[name], before[name], err_msg=name)


@pytest.mark.parametrize("case", ["up_axis/colmap.ply", None])
@pytest.mark.parametrize("out", ["", "z", "y", "-y"])
def test_the_up_axis_comes_back_as_it_came_in_or_as_asked(tmp_path, case, out):
    columns = figures.figure()
    columns["y"], columns["z"] = -columns["z"], columns["y"]
    splats, rig = inputs(tmp_path, case, columns)
    before = clouds.read_columns(splats)
    after = there_and_back(tmp_path, splats, rig, "--ply-up=-y", pose_options=[f"--ply-up={out}"] if out else [])
    x, y, z = (before[name] for name in "xyz")
    expected = {"": (x, y, z), "-y": (x, y, z), "z": (x, z, -y), "y": (x, -y, -z)}[out]
    for name, values in zip("xyz", expected, strict=True):
        np.testing.assert_allclose(after[name], values, rtol=0, atol=1e-6)


@pytest.mark.parametrize("case", ["ply_kinds/inf_opacity.ply", None])
def test_opaque_and_invisible_splats_stay(tmp_path, case):
    columns = figures.figure()
    columns["opacity"][:300], columns["opacity"][300:310] = np.inf, -np.inf
    columns["scale_1"][5] = -np.inf
    splats, rig = inputs(tmp_path, case, columns)
    before, after = clouds.read_columns(splats), there_and_back(tmp_path, splats, rig)

    def opacity(logits):
        return 1 / (1 + np.exp(-logits.astype(np.float64).clip(-700, 700)))

    np.testing.assert_allclose(opacity(after["opacity"]), opacity(before["opacity"]), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.exp(after["scale_1"]), np.exp(before["scale_1"]), rtol=1e-5)


@pytest.mark.parametrize("case", ["ply_kinds/mip.ply", None])
def test_mip_splatting_has_its_real_size(tmp_path, case, capsys):
    columns = figures.figure()
    for k in range(3):
        columns[f"scale_{k}"] -= 4.5
    columns["filter_3D"] = np.full(900, 0.012, np.float32)
    splats, rig = inputs(tmp_path, case, columns)
    after = there_and_back(tmp_path, splats, rig)
    assert np.exp(after["scale_0"]).min() > 0.0119
    assert np.exp(after["scale_0"]).max() < 0.0124
    assert "filter_3D" not in after
    assert "filter_3D" in capsys.readouterr().err


@pytest.mark.parametrize("case", ["ply_kinds/2dgs.ply", None])
def test_discs_have_a_third_scale(tmp_path, case, capsys):
    columns = figures.figure()
    del columns["scale_2"]
    splats, rig = inputs(tmp_path, case, columns)
    after = there_and_back(tmp_path, splats, rig)
    thin = np.minimum(after["scale_0"], after["scale_1"]) + np.log(1e-3)
    np.testing.assert_allclose(after["scale_2"], thin, atol=1e-5)
    assert "2DGS" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["my  old scan.ply", "lower.case.PLY", " spaced .ply", "ünïcode ’s.ply"])
def test_messages_never_change_a_files_name(tmp_path, name, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    assert run("rig", name, "--armature", "rig.blend", "--out", "out.blend") == 2
    assert f"'{name}' has no vertices" in capsys.readouterr().err
    assert run("render", name + ".none.ply", "--out", "out.png") == 2
    assert f"'{name}.none.ply'" in capsys.readouterr().err


@pytest.mark.parametrize("case", ["units/fig.ply", None])
@pytest.mark.parametrize(("option", "scale"), [([], 1), (["--rig-scale", "auto"], 10), (["--rig-scale", "10"], 10)])
def test_a_rig_in_another_unit_is_named_and_mended_on_request(tmp_path, case, option, scale, capsys):
    splats, rig = inputs(tmp_path, case, figures.figure(), "small10.blend", scale=0.1)
    there_and_back(tmp_path, splats, rig, *option)
    words = capsys.readouterr().err
    assert ("--rig-scale auto scales it" in words) == (not option)
    assert ("10 times too small" in words) == (option != ["--rig-scale", "10"])
    assert bpy.data.objects["Rig"].scale[0] == pytest.approx(scale)


@pytest.mark.parametrize("unit", [100, 1 / 0.0254])
def test_a_rig_far_too_large_is_refused_with_its_factor(tmp_path, unit, capsys):
    splats, rig = inputs(tmp_path, None, figures.figure(), scale=unit)
    out = tmp_path / "r.blend"
    assert run("rig", splats, "--armature", rig, "--out", out, "--progress", "none") == 2
    assert f"{unit:.3g} times too large for the splats; scale it (--rig-scale auto)" in capsys.readouterr().err
    there_and_back(tmp_path, splats, rig, "--rig-scale", "auto")
    assert bpy.data.objects["Rig"].scale[0] == pytest.approx(1 / unit)


def test_a_large_capture_is_not_refused(tmp_path):
    columns, rng = figures.figure(4000), np.random.default_rng(5)
    columns["x"][::2], columns["y"][::2] = rng.normal(0, 8, (2, 2000))
    columns["z"][::2] = rng.normal(0, 0.01, 2000)
    splats, rig = inputs(tmp_path, None, columns)
    there_and_back(tmp_path, splats, rig)
    assert bpy.data.objects["Rig"].scale[0] == 1.0


@pytest.mark.parametrize("case", ["up_axis/colmap.ply", None])
def test_the_axis_that_fits_the_rig_is_assumed_and_said(tmp_path, case, capsys):
    columns = figures.figure()
    columns["y"], columns["z"] = -columns["z"], columns["y"]
    splats, rig = inputs(tmp_path, case, columns)
    before, after = clouds.read_columns(splats), there_and_back(tmp_path, splats, rig)
    np.testing.assert_allclose(after["y"], before["y"], rtol=0, atol=1e-6)
    assert "assumed -Y up, so 100% of the armature's bones" in capsys.readouterr().err


def test_a_glb_says_what_it_cannot_hold_and_keeps_the_way_back(tmp_path, capsys):
    columns = far()
    columns["gps_time"] = np.arange(900.0)
    splats, rig = inputs(tmp_path, None, columns, location=UTM)
    out = tmp_path / "r.glb"
    assert run("rig", splats, "--armature", rig, "--out", out, "--progress", "none") == 0
    words = capsys.readouterr().err
    assert "no place for the columns gps_time" in words
    assert "(448252, 33, -5411943) must be added" in words or "(448252, 33, -5411944) must be added" in words
    cloud = rotate_cloud(read_splats(out).cloud, up_rotation("y"))
    for axis, name in enumerate("xyz"):
        back = cloud.means[:, axis].astype(np.float64) + cloud.offset[axis]
        np.testing.assert_allclose(back, columns[name], rtol=0, atol=1e-6)


def test_an_action_does_not_keep_what_was_posed_by_hand(tmp_path):
    """Bones that an action does not key stand at rest, as in a .glb."""
    splats, rig = inputs(tmp_path, None, figures.figure())
    armature = bpy.data.objects["Rig"]
    bone = armature.pose.bones["arm.L"]
    bone.rotation_mode = "QUATERNION"
    bone.keyframe_insert("rotation_quaternion", frame=1)
    armature.animation_data.action.name = "Wave"
    spine = armature.pose.bones["spine"]  # which carries every splat here
    spine.rotation_mode, spine.rotation_euler = "XYZ", (1.0, 0.5, 0.0)
    bpy.ops.wm.save_as_mainfile(filepath=str(rig), copy=True)
    before = clouds.read_columns(splats)
    after = there_and_back(tmp_path, splats, rig, pose_options=["--action", "Wave"])
    for name in "xyz":
        np.testing.assert_allclose(after[name], before[name], rtol=0, atol=1e-6)
