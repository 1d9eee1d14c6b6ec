# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats far from the origin keep their places among each other, and their file's coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.ply import read_ply, write_ply

UTM = (448252.0, 5411943.5, 32.0)


def columns_at(place, size: float = 0.02, extent: float = 1.0, code: str = "f8") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    columns = clouds.raw_columns(400, 0)
    for axis, name in enumerate("xyz"):
        columns[name] = (place[axis] + extent * rng.uniform(-1, 1, 400)).astype(code)
        columns[f"scale_{axis}"] = np.full(400, np.log(size), np.float32)
    return columns


def places(columns) -> np.ndarray:
    return np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=1)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("place", "size", "extent"),
    [(UTM, 0.02, 1.0), ((0.0, 0.0, 5.4e6), 0.02, 1.0), ((-3.0e7, 0.0, 0.0), 0.5, 20.0), ((900.0, 0, 0), 1e-5, 1e-3)],
)
def test_double_coordinates_come_back_bit_for_bit(tmp_path, place, size, extent, text, order):
    columns = columns_at(place, size, extent)
    cloud = read_ply(clouds.write_columns(tmp_path / "far.ply", columns, text=text, byte_order=order)).cloud
    assert cloud.offset.any()
    assert np.abs(cloud.means).max() < 100.0 * extent
    near = np.maximum(2e-7 * extent, np.spacing(np.abs(cloud.means).max(axis=0)))
    assert (np.abs(cloud.means + cloud.offset - places(columns)) <= near).all()
    assert any("moved by" in note for note in cloud.notes)
    write_ply(tmp_path / "back.ply", cloud)
    written = clouds.read_columns(tmp_path / "back.ply")
    for name in "xyz":
        assert written[name].dtype == np.float64
        np.testing.assert_array_equal(written[name], columns[name])


def test_changed_centres_are_written_in_double_precision(tmp_path):
    cloud = read_ply(clouds.write_columns(tmp_path / "far.ply", columns_at(UTM))).cloud
    moved = replace(cloud, means=cloud.means + np.float32(0.001))
    write_ply(tmp_path / "back.ply", moved)
    written = places(clouds.read_columns(tmp_path / "back.ply"))
    np.testing.assert_allclose(written, moved.means.astype(np.float64) + cloud.offset, rtol=0, atol=1e-9)


def test_the_offset_turns_with_the_axes(tmp_path):
    columns = columns_at((0.0, -5.4e6, 0.0))
    cloud = rotate_cloud(read_ply(clouds.write_columns(tmp_path / "far.ply", columns)).cloud, up_rotation("-y"))
    np.testing.assert_allclose(cloud.offset, (0.0, 0.0, 5.4e6), atol=1.0)
    write_ply(tmp_path / "back.ply", rotate_cloud(cloud, up_rotation("-y").T))
    np.testing.assert_allclose(places(clouds.read_columns(tmp_path / "back.ply")), places(columns), rtol=0, atol=1e-6)


def test_float_coordinates_are_moved_exactly_while_they_can_tell_splats_apart(tmp_path):
    columns = columns_at((20_000.0, 0.0, 0.0), code="f4")
    cloud = read_ply(clouds.write_columns(tmp_path / "far.ply", columns)).cloud
    np.testing.assert_array_equal(cloud.means.astype(np.float64) + cloud.offset, places(columns))


def test_float_coordinates_that_lost_their_splats_are_refused(tmp_path):
    path = clouds.write_columns(tmp_path / "far.ply", columns_at(UTM, code="f4"))
    with pytest.raises(InputError, match=r"far\.ply' has float coordinates.*double coordinates"):
        read_ply(path)
    coarse = clouds.write_columns(tmp_path / "coarse.ply", columns_at((100_000.0, 0.0, 0.0), code="f4"))
    assert any("rounded to steps of 0.0078" in note for note in read_ply(coarse).cloud.notes)


def test_what_no_float_can_hold_is_refused(tmp_path):
    columns = columns_at((0.0, 0.0, 0.0), extent=3e6)
    for name in "xyz":
        columns[name][:200] = 2.5e6 + 0.05 * np.arange(200)
    with pytest.raises(InputError, match="crop it"):
        read_ply(clouds.write_columns(tmp_path / "wide.ply", columns))


def test_ordinary_clouds_stay_where_they_are(tmp_path):
    for place in ((0.0, 0.0, 0.0), (30.0, -20.0, 5.0)):
        cloud = read_ply(clouds.write_columns(tmp_path / "near.ply", columns_at(place, code="f4"))).cloud
        assert not cloud.offset.any()
        assert not cloud.notes


def test_text_keeps_more_digits_than_its_type_has(tmp_path):
    columns = columns_at(UTM)
    path = clouds.write_columns(tmp_path / "far.ply", columns, text=True)
    path.write_text(path.read_text().replace("property double", "property float"))
    cloud = read_ply(path).cloud
    np.testing.assert_allclose(cloud.means + cloud.offset, places(columns), rtol=0, atol=4e-6)
