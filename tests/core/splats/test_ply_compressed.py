# SPDX-License-Identifier: GPL-3.0-or-later
"""Compressed .ply files of PlayCanvas and SuperSplat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plyfile
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.cloud import SH_C0
from gskin_addon.core.splats.ply import read_ply

AXES = ("x", "y", "z")


def quantise(values, bits):
    return np.round(values * ((1 << bits) - 1)).astype(np.uint32)


def write_compressed(path, cloud, *, color_ranges=True, short=0):
    """One splat at a time, by the letter of the format; a slow but simple reference."""
    blocks = -(-cloud.count // 256)
    names = [f"{end}_{axis}" for end in ("min", "max") for axis in AXES]
    names += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in AXES]
    if color_ranges:
        names += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    chunk = np.zeros(blocks, [(name, "f4") for name in names])
    packed = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    vertex = np.zeros(cloud.count, [(name, "u4") for name in packed])
    for block in range(blocks):
        part = cloud.select(slice(256 * block, 256 * (block + 1)))
        quantities = {"": part.means, "scale_": np.log(part.scales), "color": 0.5 + SH_C0 * part.sh[:, 0]}
        unit = {}
        for name, values in quantities.items():
            low, high = values.min(axis=0), values.max(axis=0)
            suffixes = "rgb" if name == "color" else [name + axis for axis in AXES]
            if name == "color" and not color_ranges:
                low, high = np.zeros(3), np.ones(3)
            else:
                for axis, suffix in enumerate(suffixes):
                    chunk[f"min_{suffix}"][block], chunk[f"max_{suffix}"][block] = low[axis], high[axis]
            unit[name] = np.clip((values - low) / np.maximum(high - low, 1e-12), 0.0, 1.0)
        for index in range(part.count):
            row = 256 * block + index
            for name, key in (("packed_position", ""), ("packed_scale", "scale_")):
                x, y, z = (int(quantise(unit[key][index, axis], bits)) for axis, bits in enumerate((11, 10, 11)))
                vertex[name][row] = x << 21 | y << 11 | z
            r, g, b = (int(value) for value in quantise(unit["color"][index], 8))
            vertex["packed_color"][row] = r << 24 | g << 16 | b << 8 | int(quantise(part.opacities[index], 8))
            quat = part.quats[index].astype(np.float64)
            largest = int(np.argmax(np.abs(quat)))
            quat *= np.sign(quat[largest])
            word = largest
            for component in np.delete(quat, largest):
                word = word << 10 | int(quantise(component / 2.0**0.5 + 0.5, 10))
            vertex["packed_rotation"][row] = word
    elements = [plyfile.PlyElement.describe(chunk, "chunk"), plyfile.PlyElement.describe(vertex, "vertex")]
    rest = 3 * (cloud.sh.shape[1] - 1)
    if rest:
        higher = cloud.sh[:, 1:].transpose(0, 2, 1).reshape(cloud.count, rest)
        table = np.zeros(cloud.count - short, [(f"f_rest_{i}", "u1") for i in range(rest)])
        for i in range(rest):
            table[f"f_rest_{i}"] = np.clip(np.floor((higher[short:, i] / 8.0 + 0.5) * 256.0), 0, 255)
        elements.append(plyfile.PlyElement.describe(table, "sh"))
    plyfile.PlyData(elements, byte_order="<").write(str(path))
    return path


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("color_ranges", [True, False])
def test_values_within_a_step_of_quantisation(tmp_path, degree, color_ranges):
    cloud = clouds.random_cloud(600, degree)
    cloud = replace(cloud, sh=np.clip(cloud.sh * 0.3, -1.0, 1.0))
    splats = read_ply(write_compressed(tmp_path / "c.ply", cloud, color_ranges=color_ranges))
    read = splats.cloud
    assert splats.total == read.count == 600
    assert read.sh_degree == degree
    size = np.ptp(cloud.means, axis=0).max()
    np.testing.assert_allclose(read.means, cloud.means, atol=size / 1023 * 0.51)
    np.testing.assert_allclose(np.log(read.scales), np.log(cloud.scales), atol=0.01)
    np.testing.assert_allclose(read.opacities, cloud.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(SH_C0 * read.sh[:, 0], SH_C0 * cloud.sh[:, 0], atol=0.51 / 255)
    np.testing.assert_allclose(read.sh[:, 1:], cloud.sh[:, 1:], atol=8.0 / 256)
    assert np.abs(np.sum(read.quats * cloud.quats, axis=1)).min() > 1.0 - 1e-5
    np.testing.assert_allclose(np.linalg.norm(read.quats, axis=1), 1.0, atol=1e-6)


def test_damaged_files(tmp_path):
    cloud = clouds.random_cloud(300, 1)
    path = write_compressed(tmp_path / "c.ply", cloud)
    data = path.read_bytes()
    path.write_bytes(data[:-20])
    with pytest.raises(InputError, match="300 rows of 'sh', the file holds 297"):
        read_ply(path)
    path.write_bytes(data.replace(b"min_scale_y", b"min_other_y"))
    with pytest.raises(InputError, match="chunks lack min_scale_y"):
        read_ply(path)
    path.write_bytes(data.replace(b"element chunk 2", b"element chunk 1"))
    with pytest.raises(InputError, match="1 chunks for 300 splats"):
        read_ply(path)
    path.write_bytes(data.replace(b"binary_little_endian", b"binary_big_endian"))
    with pytest.raises(InputError, match=r"compressed \.ply in binary_big_endian"):
        read_ply(path)
    with pytest.raises(InputError, match="one byte per f_rest value and splat"):
        read_ply(write_compressed(tmp_path / "c.ply", cloud, short=1))


def test_invalid_ranges_are_dropped_with_their_chunk(tmp_path):
    path = write_compressed(tmp_path / "c.ply", clouds.random_cloud(300, 0))
    ply = plyfile.PlyData.read(str(path))
    ply["chunk"].data["max_y"][1] = np.nan
    ply.write(str(tmp_path / "bad.ply"))
    with pytest.raises(InputError, match="44 of 300 splats"):
        read_ply(tmp_path / "bad.ply")
    splats = read_ply(tmp_path / "bad.ply", drop_invalid=True)
    np.testing.assert_array_equal(splats.kept, np.arange(256))


@pytest.mark.skipif(not clouds.ASSETS.is_dir(), reason="no shared assets")
def test_real_file_against_its_uncompressed_original():
    folder = clouds.ASSETS / "splats"
    packed, original = (read_ply(folder / f"pc_biker{suffix}").cloud for suffix in (".compressed.ply", ".ply"))
    np.testing.assert_array_equal(packed.means, original.means)
    np.testing.assert_array_equal(packed.sh, original.sh)
    np.testing.assert_allclose(packed.scales, original.scales, rtol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(packed.quats * original.quats, axis=1)), 1.0, atol=1e-6)
    # The uncompressed file avoids infinite logits: its opacities end 0.0001 before 0 and 1.
    np.testing.assert_allclose(packed.opacities, original.opacities, atol=1.1e-4)
