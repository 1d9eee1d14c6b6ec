# SPDX-License-Identifier: GPL-3.0-or-later
"""Kinds of .ply besides plain 3DGS: opaque and sizeless splats, 2DGS, unfused Mip-Splatting, 4DGS."""

from __future__ import annotations

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.ply import read_ply, write_ply


def read(tmp_path, columns, **options):
    return read_ply(clouds.write_columns(tmp_path / "in.ply", columns, **options)).cloud


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("code", ["f4", "f8"])
def test_infinite_logits_and_no_size_are_legal(tmp_path, code, text):
    columns = clouds.raw_columns(20, 1)
    columns["opacity"] = columns["opacity"].astype(code)
    columns["opacity"][:3] = np.inf, -np.inf, 1e30
    columns["scale_1"][4] = -np.inf
    cloud = read(tmp_path, columns, text=text)
    np.testing.assert_array_equal(cloud.opacities[:3], [1.0, 0.0, 1.0])
    assert cloud.scales[4, 1] == 0.0
    assert not cloud.notes
    write_ply(tmp_path / "out.ply", cloud)
    written = clouds.read_columns(tmp_path / "out.ply")
    np.testing.assert_array_equal(written["opacity"], columns["opacity"])
    np.testing.assert_array_equal(written["scale_1"], columns["scale_1"])


def test_infinite_size_and_nan_are_not(tmp_path):
    for name, value in (("scale_0", np.inf), ("opacity", np.nan), ("x", np.inf)):
        columns = clouds.raw_columns(20, 0)
        columns[name][3] = value
        with pytest.raises(InputError, match="1 of 20 splats"):
            read(tmp_path, columns)


def test_two_scales_are_discs(tmp_path):
    columns = clouds.raw_columns(50, 1)
    del columns["scale_2"]
    cloud = read(tmp_path, columns)
    np.testing.assert_allclose(cloud.scales[:, 0], np.exp(columns["scale_0"].astype(np.float64)), rtol=1e-6)
    np.testing.assert_allclose(cloud.scales[:, 2], 1e-3 * cloud.scales[:, :2].min(axis=1), rtol=1e-6)
    assert any("2DGS" in note for note in cloud.notes)
    write_ply(tmp_path / "out.ply", cloud)
    again = read_ply(tmp_path / "out.ply").cloud
    np.testing.assert_allclose(again.scales, cloud.scales, rtol=1e-6)
    assert not again.notes


def test_one_scale_is_a_ball_and_gaps_are_errors(tmp_path):
    columns = clouds.raw_columns(50, 0)
    del columns["scale_2"], columns["scale_1"]
    cloud = read(tmp_path, columns)
    np.testing.assert_array_equal(cloud.scales, np.repeat(cloud.scales[:, :1], 3, axis=1))
    assert any("balls" in note for note in cloud.notes)
    columns["scale_2"] = columns.pop("scale_0")
    with pytest.raises(InputError, match="scale_0, scale_1"):
        read(tmp_path, columns)


@pytest.mark.parametrize("flat", [False, True])
def test_the_filter_of_mip_splatting_is_fused(tmp_path, flat):
    columns = clouds.raw_columns(60, 1)
    columns["filter_3D"] = np.random.default_rng(1).uniform(0, 2, 60).astype(np.float32)
    columns["filter_3D"][5] = 0.0
    columns["scale_0"][6], columns["filter_3D"][6] = -np.inf, 0.0
    if flat:
        del columns["scale_2"]
    cloud = read(tmp_path, columns)
    axes = 2 if flat else 3
    square = np.exp(np.stack([columns[f"scale_{k}"].astype(np.float64) for k in range(axes)], axis=1)) ** 2
    wide = square + columns["filter_3D"].astype(np.float64)[:, None] ** 2
    np.testing.assert_allclose(cloud.scales[:, :axes], np.sqrt(wide), rtol=1e-6)
    with np.errstate(invalid="ignore"):
        kept = np.sqrt(np.prod(square, axis=1) / np.prod(wide, axis=1))
    kept[6] = 1.0
    np.testing.assert_allclose(cloud.opacities, kept / (1 + np.exp(-columns["opacity"].astype(np.float64))), rtol=2e-6)
    assert "filter_3D" not in cloud.extra
    assert any("filter_3D" in note for note in cloud.notes)
    write_ply(tmp_path / "out.ply", cloud)
    again = read_ply(tmp_path / "out.ply").cloud  # and not fused a second time
    np.testing.assert_allclose(again.scales, cloud.scales, rtol=1e-6)
    np.testing.assert_allclose(again.opacities, cloud.opacities, rtol=1e-4, atol=1e-30)


@pytest.mark.parametrize("names", [("t", "scale_t"), ("trbf_center", "motion_0", "omega_1"), ("t", "rot_r_0")])
def test_columns_of_time_are_kept_with_a_word(tmp_path, names):
    columns = clouds.raw_columns(20, 0)
    columns |= {name: np.arange(20, dtype=np.float32) for name in names}
    cloud = read(tmp_path, columns)
    assert any("change with time" in note and names[0] in note for note in cloud.notes)
    write_ply(tmp_path / "out.ply", cloud)
    written = clouds.read_columns(tmp_path / "out.ply")
    for name in names:
        np.testing.assert_array_equal(written[name], columns[name])
