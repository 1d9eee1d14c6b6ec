# SPDX-License-Identifier: GPL-3.0-or-later
"""Good files: every layout reads to the same splats, and writing gives the stored bits back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plyfile
import pytest
import splat_clouds as clouds
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import read_ply, write_ply

FORMATS = ("binary_little_endian", "binary_big_endian", "ascii")
TEXT_AND_ORDER = {
    "binary_little_endian": (False, "<"),
    "binary_big_endian": (False, ">"),
    "ascii": (True, "="),
}


def reference(columns: dict[str, np.ndarray]) -> SplatCloud:
    """Decoding as the INRIA code does it, in float64, from all columns at once."""
    column = {name: values.astype(np.float64) for name, values in columns.items()}
    quats = np.stack([column[f"rot_{i}"] for i in range(4)], axis=1)
    rest = [column[f"f_rest_{i}"] for i in range(sum(name.startswith("f_rest_") for name in columns))]
    dc = np.stack([column[f"f_dc_{i}"] for i in range(3)], axis=1)[:, None, :]
    if rest:
        # features_extra.reshape((N, 3, K - 1)), then transpose(1, 2)
        higher = np.stack(rest, axis=1).reshape(len(dc), 3, -1).transpose(0, 2, 1)
        dc = np.concatenate([dc, higher], axis=1)
    return SplatCloud(
        means=np.stack([column[name] for name in "xyz"], axis=1),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(np.stack([column[f"scale_{i}"] for i in range(3)], axis=1)),
        opacities=1.0 / (1.0 + np.exp(-column["opacity"])),
        sh=dc,
    )


def assert_same(cloud: SplatCloud, expected: SplatCloud, rtol: float = 3e-7) -> None:
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(cloud, name), getattr(expected, name), rtol=rtol, atol=1e-30, err_msg=name)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    degree=st.integers(0, 4),
    fmt=st.sampled_from(FORMATS),
    count=st.integers(1, 40),
    normals=st.booleans(),
    extras=st.lists(st.sampled_from(["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"]), max_size=3),
    doubles=st.booleans(),
    random=st.randoms(use_true_random=False),
)
def test_any_layout_reads_and_rewrites_the_stored_bits(tmp_path, degree, fmt, count, normals, extras, doubles, random):
    columns = clouds.raw_columns(count, degree, seed=random.randrange(10**6))
    if not normals:
        columns = {name: column for name, column in columns.items() if name not in ("nx", "ny", "nz")}
    if doubles:
        columns["x"] = columns["x"].astype(np.float64) / 3.0
        columns["opacity"] = columns["opacity"].astype(np.float64) / 3.0
        columns["rot_2"] = columns["rot_2"].astype(np.float64) / 3.0
    for number, code in enumerate(extras):
        columns[f"extra_{number}"] = (np.arange(count) * 5 % 120 - (60 if code[0] != "u" else 0)).astype(code)
    names = list(columns)
    random.shuffle(names)
    text, order = TEXT_AND_ORDER[fmt]
    path = clouds.write_columns(tmp_path / "in.ply", {n: columns[n] for n in names}, text=text, byte_order=order)

    splats = read_ply(path)
    assert splats.total == splats.cloud.count == count
    assert splats.cloud.sh_degree == degree
    assert_same(splats.cloud, reference(columns))

    out_format = random.choice(FORMATS)
    write_ply(tmp_path / "out.ply", splats.cloud, fmt=out_format)
    written = clouds.read_columns(tmp_path / "out.ply")
    assert plyfile.PlyData.read(str(tmp_path / "out.ply")).text == (out_format == "ascii")
    for name, column in columns.items():
        assert written[name].dtype.newbyteorder("=") == column.dtype
        np.testing.assert_array_equal(written[name], column, err_msg=name)
    assert set(written) == set(columns) | {"nx", "ny", "nz"}


def test_only_changed_splats_are_encoded_again(tmp_path):
    columns = clouds.raw_columns(50, 1)
    cloud = read_ply(clouds.write_columns(tmp_path / "in.ply", columns)).cloud
    scales, opacities, quats = cloud.scales.copy(), cloud.opacities.copy(), cloud.quats.copy()
    scales[3] *= 2.0
    opacities[4] = 0.25
    quats[5] = (0.5, 0.5, 0.5, 0.5)
    write_ply(tmp_path / "out.ply", replace(cloud, scales=scales, opacities=opacities, quats=quats))
    written = clouds.read_columns(tmp_path / "out.ply")
    for name, row in (("scale_0", 3), ("opacity", 4), ("rot_1", 5)):
        keep = np.arange(50) != row
        np.testing.assert_array_equal(written[name][keep], columns[name][keep])
        assert written[name][row] != columns[name][row]
    np.testing.assert_allclose(written["scale_0"][3], columns["scale_0"][3] + np.log(2.0), rtol=1e-6)
    np.testing.assert_allclose(written["opacity"][4], np.log(0.25 / 0.75), rtol=1e-6)
    assert written["rot_1"][5] == 0.5


def test_selected_splats_keep_their_bits(tmp_path):
    columns = clouds.raw_columns(60, 2)
    cloud = read_ply(clouds.write_columns(tmp_path / "in.ply", columns)).cloud
    index = np.random.default_rng(1).permutation(60)[:25]
    write_ply(tmp_path / "out.ply", cloud.select(index))
    written = clouds.read_columns(tmp_path / "out.ply")
    for name, column in columns.items():
        np.testing.assert_array_equal(written[name], column[index], err_msg=name)


def test_turned_cloud_keeps_the_bits_that_do_not_turn(tmp_path):
    columns = clouds.raw_columns(60, 1)
    cloud = rotate_cloud(read_ply(clouds.write_columns(tmp_path / "in.ply", columns)).cloud, up_rotation("-y"))
    write_ply(tmp_path / "out.ply", cloud)
    written = clouds.read_columns(tmp_path / "out.ply")
    for name in ("opacity", "scale_0", "f_dc_2"):
        np.testing.assert_array_equal(written[name], columns[name])
    for name, expected in (
        ("y", columns["z"]),
        ("z", -columns["y"]),
        ("ny", columns["nz"]),
        ("nz", -columns["ny"]),
    ):
        np.testing.assert_array_equal(written[name], expected)
    assert_same(read_ply(tmp_path / "out.ply").cloud, cloud)


def test_cloud_that_came_from_no_file(tmp_path):
    cloud = clouds.random_cloud(300, 3)
    opacities, scales = cloud.opacities.copy(), cloud.scales.copy()
    opacities[:2] = 0.0, 1.0
    scales[0] = 0.0
    cloud = replace(cloud, opacities=opacities, scales=scales, extra={"group": np.arange(300, dtype=np.int64)})
    write_ply(tmp_path / "out.ply", cloud)
    again = read_ply(tmp_path / "out.ply").cloud
    assert_same(again, cloud, rtol=3e-6)
    assert again.opacities[0] == 0.0
    assert again.opacities[1] == 1.0
    assert (again.scales[0] == 0.0).all()
    np.testing.assert_array_equal(again.extra["group"], np.arange(300))
    assert not list(tmp_path.glob("*.part"))


def test_elements_around_the_vertices_are_skipped(tmp_path):
    columns = clouds.raw_columns(20, 0)
    before = plyfile.PlyElement.describe(np.zeros(7, [("fx", "f8"), ("id", "u1")]), "camera")
    after = plyfile.PlyElement.describe(np.zeros(3, [("e", "f4")]), "extrinsic")
    for text in (False, True):
        path = clouds.write_columns(tmp_path / "in.ply", columns, text=text, first=(before,), more=(after,))
        assert_same(read_ply(path).cloud, reference(columns))


def test_windows_line_ends_and_comments(tmp_path):
    columns = clouds.raw_columns(5, 0)
    path = clouds.write_columns(tmp_path / "in.ply", columns, text=True)
    data = path.read_bytes().replace(b"element", b"comment made by hand\nelement").replace(b"\n", b"\r\n")
    path.write_bytes(data)
    assert_same(read_ply(path).cloud, reference(columns))


def test_base_colors_and_bounds():
    cloud = clouds.random_cloud(100, 1)
    np.testing.assert_allclose(cloud.base_colors(), np.clip(0.5 + 0.28209479 * cloud.sh[:, 0], 0, 1), atol=1e-6)
    lower, upper = cloud.bounds()
    assert (cloud.means >= lower).all()
    assert (cloud.means <= upper).all()


def test_wrong_shapes_are_refused():
    cloud = clouds.random_cloud(10, 1)
    with pytest.raises(ValueError, match="quats has shape"):
        replace(cloud, quats=cloud.quats[:, :3])
    with pytest.raises(ValueError, match="sh has shape"):
        replace(cloud, sh=cloud.sh[:, :3])


@pytest.mark.skipif(not clouds.ASSETS.is_dir(), reason="no shared assets")
@pytest.mark.parametrize("name", ["pc_biker", "pc_statue_angel"])
def test_real_files_are_rewritten_byte_for_byte(tmp_path, name):
    path = clouds.ASSETS / "splats" / f"{name}.ply"
    cloud = read_ply(path).cloud
    assert_same(cloud, reference(clouds.read_columns(path)))
    write_ply(tmp_path / "out.ply", cloud)
    before, after = clouds.read_columns(path), clouds.read_columns(tmp_path / "out.ply")
    for column in before:
        np.testing.assert_array_equal(after[column].view(np.uint32), before[column].view(np.uint32), err_msg=column)


def test_more_than_five_million_splats(tmp_path):
    count = 5_000_001
    columns = clouds.raw_columns(1000, 0)
    names = [name for name in columns if name not in ("nx", "ny", "nz")]
    header = "".join(f"property float {name}\n" for name in names)
    block = np.stack([columns[name] for name in names], axis=1).tobytes()
    path = tmp_path / "huge.ply"
    with path.open("wb") as file:
        file.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{header}end_header\n".encode())
        for _ in range(5000):
            file.write(block)
        file.write(block[: 4 * len(names)])
    cloud = read_ply(path).cloud
    path.unlink()
    assert cloud.count == count
    expected = reference({name: columns[name] for name in names})
    for rows in (slice(0, 1000), slice(count - 1001, count - 1)):
        assert_same(cloud.select(rows), expected)
    assert (cloud.means[-1] == expected.means[0]).all()


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
@pytest.mark.parametrize("text", [False, True])
def test_colours_in_place_of_harmonics(tmp_path, kind, text):
    """As some programs write splats without view-dependent colour."""
    rng = np.random.default_rng(0)
    rgb = rng.uniform(0.0, 1.0, (40, 3))
    largest = 1.0 if kind == "f4" else float(np.iinfo(kind).max)
    columns = {name: values for name, values in clouds.raw_columns(40, 0).items() if not name.startswith("f_dc")}
    for axis, name in enumerate(("red", "green", "blue")):
        columns[name] = (rgb[:, axis] * largest).astype(kind)
    cloud = read_ply(clouds.write_columns(tmp_path / "a.ply", columns, text=text)).cloud
    np.testing.assert_allclose(cloud.base_colors(), rgb, atol=1 / 255)
    assert cloud.sh_degree == 0


def test_colours_do_not_count_where_there_are_harmonics(tmp_path):
    columns = clouds.raw_columns(10, 0)
    for name in ("red", "green", "blue"):
        columns[name] = np.zeros(10, np.uint8)
    cloud = read_ply(clouds.write_columns(tmp_path / "a.ply", columns)).cloud
    np.testing.assert_array_equal(cloud.sh[:, 0, 0], columns["f_dc_0"])
    assert set(cloud.extra) >= {"red", "green", "blue"}
