# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad files: one sentence that names the file, the reason and the remedy."""

from __future__ import annotations

import numpy as np
import plyfile
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.splats.ply import read_ply, write_ply


def message(path, **options) -> str:
    with pytest.raises(InputError) as caught:
        read_ply(path, **options)
    text = str(caught.value)
    assert path.name in text
    assert "\n" not in text
    assert text.endswith(".")
    return text


@pytest.fixture
def columns():
    return clouds.raw_columns(20, 1)


def test_missing_file_and_folder(tmp_path):
    assert "No such file" in message(tmp_path / "none.ply")
    assert "directory" in message(tmp_path)


@pytest.mark.parametrize("content", [b"", b"solid cube\n", b"\x89PNG\r\n\x1a\n", b"plywood\n"])
def test_not_a_ply(tmp_path, content):
    path = tmp_path / "other.ply"
    path.write_bytes(content)
    assert "not a PLY file" in message(path)


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n", "cut off inside its PLY header"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "'element vertex many'"),
        ("ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "'element vertex -3'"),
        ("ply\nformat ascii 1.0\nelement vertex 3\nproperty half x\nend_header\n", "'property half x'"),
        ("ply\nformat ascii 1.0\nproperty float x\nend_header\n", "'property float x'"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty int x\nend_header\n",
            "'property int x'",
        ),
        ("ply\nformat binary_pdp_endian 1.0\nelement vertex 3\nend_header\n", "'binary_pdp_endian'"),
        ("ply\nelement vertex 3\nend_header\n", "PLY format ''"),
        ("ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int v\nend_header\n", "no vertices"),
    ],
)
def test_bad_header(tmp_path, header, expected):
    path = tmp_path / "bad.ply"
    path.write_text(header)
    assert expected in message(path)


def test_mesh_and_point_cloud(tmp_path):
    vertex = plyfile.PlyElement.describe(np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")]), "vertex")
    face = np.empty(1, [("vertex_indices", object)])
    face[0] = ([0, 1, 2],)
    path = tmp_path / "mesh.ply"
    plyfile.PlyData([vertex, plyfile.PlyElement.describe(face, "face", val_types={"vertex_indices": "i4"})]).write(path)
    assert "is a mesh, not Gaussian splats" in message(path)
    plyfile.PlyData([vertex]).write(path)
    assert "is a point cloud, not Gaussian splats" in message(path)


@pytest.mark.parametrize("gone", [("x",), ("opacity",), ("scale_1",), ("rot_0", "f_dc_1"), ("f_rest_4",)])
def test_missing_properties_are_named(tmp_path, columns, gone):
    for name in gone:
        del columns[name]
    text = message(clouds.write_columns(tmp_path / "in.ply", columns))
    assert all(name in text for name in gone)


def test_partial_band(tmp_path, columns):
    del columns["f_rest_8"]
    assert "8 f_rest properties, not 0, 9, 24, 45, 72" in message(clouds.write_columns(tmp_path / "in.ply", columns))


@pytest.mark.parametrize("text", [False, True])
def test_cut_off(tmp_path, columns, text):
    path = clouds.write_columns(tmp_path / "in.ply", columns, text=text)
    data = path.read_bytes()
    lines = data.splitlines(keepends=True)
    data = b"".join(lines[:-5]) if text else data[: -5 * 4 * len(columns) + 3]
    path.write_bytes(data)
    assert "announces 20 splats, the file holds 15" in message(path)


def test_cut_off_inside_a_line(tmp_path, columns):
    path = clouds.write_columns(tmp_path / "in.ply", columns, text=True)
    path.write_bytes(path.read_bytes()[:-60])
    assert "splat 19 has" in message(path)


@pytest.mark.parametrize("text", [False, True])
def test_absurd_count_takes_no_memory(tmp_path, columns, text):
    path = clouds.write_columns(tmp_path / "in.ply", columns, text=text)
    path.write_bytes(path.read_bytes().replace(b"element vertex 20", b"element vertex 20000000000000"))
    assert "announces 20000000000000 splats" in message(path)


def test_words_in_ascii(tmp_path, columns):
    path = clouds.write_columns(tmp_path / "in.ply", columns, text=True)
    lines = path.read_text().splitlines()
    lines[-3] = " ".join(["wrong", *lines[-3].split()[1:]])
    path.write_text("\n".join(lines) + "\n")
    assert "splat 17 holds 'wrong'" in message(path)


@pytest.mark.parametrize("text", [False, True])
def test_no_splats(tmp_path, columns, text):
    empty = {name: column[:0] for name, column in columns.items()}
    assert "has no splats" in message(clouds.write_columns(tmp_path / "in.ply", empty, text=text))


@pytest.mark.parametrize("text", [False, True])
def test_invalid_splats_are_counted_and_can_be_dropped(tmp_path, columns, text):
    columns["x"][2] = np.nan
    columns["opacity"][3] = np.nan
    columns["scale_1"][3] = np.inf
    columns["f_rest_7"][4] = -np.inf
    columns["scale_0"][5] = 200.0  # exp overflows float32
    for axis in range(4):
        columns[f"rot_{axis}"][6] = 0.0
    columns["nx"][7] = np.nan  # normals do not matter
    path = clouds.write_columns(tmp_path / "in.ply", columns, text=text)
    text_ = message(path)
    assert "5 of 20 splats" in text_
    assert "--drop-invalid" in text_
    splats = read_ply(path, drop_invalid=True)
    kept = np.delete(np.arange(20), [2, 3, 4, 5, 6])
    np.testing.assert_array_equal(splats.kept, kept)
    assert (splats.total, splats.dropped, splats.cloud.count) == (20, 5, 15)
    np.testing.assert_array_equal(splats.cloud.means[:, 1], columns["y"][kept])
    write_ply(tmp_path / "out.ply", splats.cloud)
    np.testing.assert_array_equal(clouds.read_columns(tmp_path / "out.ply")["rot_3"], columns["rot_3"][kept])


def test_nothing_but_invalid_splats(tmp_path, columns):
    columns["z"][:] = np.nan
    assert "all 20 splats" in message(clouds.write_columns(tmp_path / "in.ply", columns), drop_invalid=True)


def test_writer_refuses(tmp_path):
    cloud = clouds.random_cloud(3, 0)
    with pytest.raises(InputError, match="'bin' is no PLY format"):
        write_ply(tmp_path / "out.ply", cloud, fmt="bin")
    with pytest.raises(InputError, match="no splats to write"):
        write_ply(tmp_path / "out.ply", cloud.select(slice(0, 0)))
    with pytest.raises(GSkinError, match="cannot be written"):
        write_ply(tmp_path / "none" / "out.ply", cloud)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(GSkinError, match="cannot be written"):
        write_ply(tmp_path / "file" / "out.ply", cloud)


def test_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "out.ply"
    cloud = clouds.random_cloud(3, 0)
    write_ply(path, cloud)
    before = path.read_bytes()

    def full(*_args: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gskin_addon.core.splats.ply._write_rows", full)
    with pytest.raises(GSkinError, match="No space left on device"):
        write_ply(path, cloud)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
