# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY files with list properties, before the splats and among their values: the splats are read as without them."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats import ply_lists
from gskin_addon.core.splats.ply import read_ply, read_ply_pieces, write_ply

COUNT = 50
FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@pytest.fixture
def columns():
    return clouds.raw_columns(COUNT, 1)


def row_bytes(values, kinds, order):
    """One row: numbers, and lists with their length before them; kinds: code, or codes of length and items."""
    parts = []
    for value, kind in zip(values, kinds, strict=True):
        length, item = kind if isinstance(kind, tuple) else ("", kind)
        if order == "=":
            words = [len(value), *value] if length else [value]
            parts += [f"{word:.9g}" for word in words]
            continue
        if length:
            parts.append(np.array(len(value), order + length).tobytes())
        parts.append(np.array(value, order + item).tobytes())
    return (" ".join(parts) + "\n").encode() if order == "=" else b"".join(parts)


def write_with_lists(path, columns, form="binary_little_endian", *, before=40, inside=(("links", 5, 4),)):
    """The splats with patches before them and lists among their properties: (name, most values, place)."""
    rng, order = np.random.default_rng(3), FORMATS[form]
    names, kinds = list(columns), ["f4"] * len(columns)
    for name, _, place in inside:
        names.insert(place, name)
        kinds.insert(place, ("u2", "i4"))
    most = {name: length for name, length, _ in inside}
    types = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int"}

    def numbers(longest, code):
        return rng.integers(0, 100, rng.integers(0, longest + 1)).astype(code)

    def declared(name, kind):
        words = f"list {types[kind[0]]} {types[kind[1]]}" if isinstance(kind, tuple) else types[kind]
        return f"property {words} {name}\n"

    patch = {"vertex_indices": ("u1", "u4"), "quality": "f8", "tags": ("u4", "u2")}
    header = f"ply\nformat {form} 1.0\nelement patch {before}\n"
    header += "".join(declared(*each) for each in patch.items()) + f"element vertex {COUNT}\n"
    header += "".join(map(declared, names, kinds)) + "end_header\n"
    patches = [(numbers(6, "u4"), rng.random(), numbers(300, "u2")) for _ in range(before)]
    rows = [row_bytes(values, patch.values(), order) for values in patches]
    for splat in range(COUNT):
        values = [numbers(most[name], "i4") if name in most else columns[name][splat] for name in names]
        rows.append(row_bytes(values, kinds, order))
    path.write_bytes(header.encode() + b"".join(rows))
    return path


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    "inside", [(), (("links", 5, 4),), (("first", 3, 0), ("next", 0, 1), ("wide", 900, 20), ("last", 4, 999))]
)
def test_splats_are_those_without_lists(tmp_path, columns, form, inside, monkeypatch):
    monkeypatch.setattr(ply_lists, "_BYTES", 1000)  # rows that are longer, and pieces that end within one
    path = write_with_lists(tmp_path / "lists.ply", columns, form, inside=inside)
    loaded, plain = read_ply(path), read_ply(clouds.write_columns(tmp_path / "plain.ply", columns))
    exact = {"rtol": 1e-6} if form == "ascii" else {"rtol": 0}
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(loaded.cloud, name), getattr(plain.cloud, name), **exact)
    assert set(loaded.cloud.extra) == set(plain.cloud.extra)
    assert any("lists of its splats" in note for note in loaded.cloud.notes) == bool(inside)
    write_ply(tmp_path / "again.ply", loaded.cloud)
    assert read_ply(tmp_path / "again.ply").cloud.count == COUNT


@pytest.mark.parametrize("form", FORMATS)
def test_cut_off_anywhere(tmp_path, columns, form):
    data = write_with_lists(tmp_path / "lists.ply", columns, form).read_bytes()
    start = data.index(b"end_header") + 11
    path = tmp_path / "cut.ply"
    for end in {*np.linspace(start, len(data) - 40, 40).astype(int).tolist()}:
        path.write_bytes(data[:end])
        with pytest.raises(InputError, match=r"cut off|damaged|expected"):
            read_ply(path)


def hostile(path, rows, count_type="int", count=3):
    """A binary file whose element before the splats has one list a row."""
    header = f"ply\nformat binary_little_endian 1.0\nelement odd {count}\nproperty list {count_type} uchar v\n"
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)),
             *(f"rot_{i}" for i in range(4))]  # fmt: skip
    header += "element vertex 1\n" + "".join(f"property float {name}\n" for name in names) + "end_header\n"
    path.write_bytes(header.encode() + rows + np.ones(len(names), "<f4").tobytes())
    return path


def test_rows_of_a_hostile_file(tmp_path):
    def row(length, items=b""):
        return np.array(length, "<i4").tobytes() + items

    path = tmp_path / "odd.ply"
    assert read_ply(hostile(path, row(0) + row(2, b"ab") + row(1, b"c"))).cloud.count == 1
    with pytest.raises(InputError, match=r"damaged .a list of -5 values in 'odd'"):
        read_ply(hostile(path, row(0) + row(-5)))
    with pytest.raises(InputError, match=r"cut off .1 of 3 rows of 'odd'"):
        read_ply(hostile(path, row(0) + row(2**31 - 1) + row(0)))
    with pytest.raises(InputError, match="cut off"):
        read_ply(hostile(path, row(0) * 3, count=2**62))
    with pytest.raises(InputError, match="not PLY"):
        read_ply(hostile(path, row(0) * 3, count_type="float"))


def test_memory_and_steps(tmp_path, columns):
    """Many lists are passed over in small pieces, and none is kept."""
    header = b"ply\nformat binary_little_endian 1.0\nelement odd 200000\nproperty list uchar float v\n"
    row = b"\x06" + bytes(24)
    plain = clouds.write_columns(tmp_path / "plain.ply", columns).read_bytes()
    path = tmp_path / "long.ply"
    rest = plain[plain.index(b"element vertex") :].replace(b"end_header\n", b"end_header\n" + row * 200_000)
    path.write_bytes(header + rest)
    tracemalloc.start()
    steps = read_ply_pieces(path, False)
    shares = list(steps)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(shares) > 15
    assert peak < 4_000_000 < path.stat().st_size
