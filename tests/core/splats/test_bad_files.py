# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged, hostile and odd files of every format: one sentence with the file and a remedy, and little memory."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
import struct
import sys
import tracemalloc
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splat_clouds import random_cloud

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.formats import FORMATS, read_splats
from gskin_addon.core.splats.gltf_file import write_gltf
from gskin_addon.core.splats.loaded import EXPANSION, FREE_BYTES
from gskin_addon.core.splats.ply import write_ply
from gskin_addon.core.splats.spz import write_spz

pytest.importorskip("PIL.Image")  # decodes the images of .sog

WRITERS = {name: (form.suffixes[0], form.write) for name, form in FORMATS.items()}
WRITERS["spz 4"] = (".spz", partial(write_spz, version=4))
WRITERS["gltf text"] = (".gltf", write_gltf)
KINDS = sorted(WRITERS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A file of each kind with 300 splats of degree 2."""
    folder = tmp_path_factory.mktemp("whole")
    paths = {}
    for name, (suffix, write) in WRITERS.items():
        paths[name] = folder / f"{name.replace(' ', '_')}{suffix}"
        write(paths[name], random_cloud(300, 2))
    return paths


def refusal(path: Path) -> str:
    """The one sentence that reading the file gives; it names the file."""
    with pytest.raises(InputError) as caught:
        read_splats(path)
    sentence = caught.value.plain
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert path.name in sentence or path.parent.name in sentence
    assert re.search(r"[;,] |, and ", sentence), "no remedy"
    return sentence


@pytest.mark.parametrize("name", KINDS)
def test_cut_off_anywhere(whole, tmp_path, name):
    data = whole[name].read_bytes()
    path = tmp_path / whole[name].name
    rng = np.random.default_rng(1)
    ends = {*range(0, 64), *range(max(0, len(data) - 40), len(data)), *rng.integers(0, len(data), 60).tolist()}
    for end in sorted(ends):
        path.write_bytes(data[:end])
        if name == "splat" and end and end % 32 == 0:
            assert read_splats(path).total == end // 32  # nothing in such a file tells how many there should be
        else:
            refusal(path)


@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_changed_bytes_are_refused_or_read_as_finite_splats(whole, tmp_path, name, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(whole[name].read_bytes())
    reach = len(data) if rng.random() < 0.5 else min(len(data), 400)  # headers more often
    for place in rng.integers(0, reach, rng.integers(1, 6)):
        data[place] = rng.integers(0, 256)
    path = tmp_path / whole[name].name
    path.write_bytes(data)
    try:
        cloud = read_splats(path, drop_invalid=True).cloud
    except InputError:
        refusal(path)
        return
    for values in (cloud.means, cloud.scales, cloud.quats, cloud.opacities, cloud.sh):
        assert np.isfinite(values).all()
    np.testing.assert_allclose(np.linalg.norm(cloud.quats, axis=1), 1.0, atol=1e-5)
    assert (cloud.scales >= 0.0).all()


def memory_of(path: Path) -> int:
    """Most bytes that reading the file has at a time, whether it succeeds or not."""
    tracemalloc.start()
    try:
        read_splats(path)
    except InputError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


TIMES = {"ply": 4, "compressed ply": 7, "splat": 4, "ksplat": 4, "gltf": 3, "gltf text": 3}
TIMES |= {"spz": 12, "spz 4": 12, "sog": 20}
"""Memory over the file's size, for noisy splats of degree 3; as `docs/formats.md` states it."""


@pytest.mark.parametrize("name", KINDS)
def test_memory_is_bounded_by_the_size_of_the_file(tmp_path, name):
    suffix, write = WRITERS[name]
    cloud = random_cloud(40_000, 3)
    write(tmp_path / f"a{suffix}", replace(cloud, sh=0.1 * cloud.sh))
    read_splats(tmp_path / f"a{suffix}")
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert memory_of(tmp_path / f"a{suffix}") <= 4e6 + TIMES[name] * size


def spz_bytes(count: int, *, version: int = 3, degree: int = 3, body: bytes = b"") -> bytes:
    return gzip.compress(b"NGSP" + struct.pack("<IIBBBB", version, count, degree, 12, 0, 0) + body)


def spz4_bytes(count: int, degree: int = 0) -> bytes:
    sizes = [9, 1, 3, 3, 4]
    table = b"".join(struct.pack("<QQ", 20, size * count) for size in sizes)
    return b"NGSP" + struct.pack("<IIBBBBI12x", 4, count, degree, 12, 0, 5, 32) + table + bytes(100)


def ksplat_bytes(count: int, sections: int = 1) -> bytes:
    head = struct.pack("<BB2xIIIIH", 0, 1, sections, sections, count, count, 0).ljust(4096, b"\0")
    return head + struct.pack("<IIIIfH2xIIIIH", count, count, 0, 0, 0.0, 0, 0, 0, 0, 0, 0).ljust(1024, b"\0")


def glb_bytes(document: dict, binary: bytes = b"") -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, **document}).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


NUMBERS = {"codebook": [0.0] * 256}


def sog_meta(count: int, **changes) -> dict:
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {**NUMBERS, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {**NUMBERS, "files": ["sh0.webp"]},
    }
    return {**meta, **changes}


def zipped(**files: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name.replace("__", "."), data)
    return buffer.getvalue()


def webp_announcing(width: int, height: int) -> bytes:
    body = b"\x2f" + struct.pack("<I", (width - 1) | (height - 1) << 14) + bytes(50)
    return struct.pack("<4sI4s4sI", b"RIFF", len(body) + 12, b"WEBP", b"VP8L", len(body)) + body


def splat_gltf(count: int) -> dict:
    """A document of one primitive whose accessors announce `count` splats in a buffer of 1000 bytes."""
    names = ["POSITION", *(f"KHR_gaussian_splatting:{word}" for word in ("ROTATION", "SCALE", "OPACITY"))]
    names.append("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0")
    kinds = ["VEC3", "VEC4", "VEC3", "SCALAR", "VEC3"]
    primitive = {
        "attributes": {name: place for place, name in enumerate(names)},
        "mode": 0,
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse"}},
    }
    return {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": kind} for kind in kinds],
        "bufferViews": [{"buffer": 0, "byteLength": 1000}],
        "buffers": [{"byteLength": 1000}],
    }


HUGE = 2**31 - 1
PLY = ["ply", "format binary_little_endian 1.0", "element vertex 2147483648"]
PLY += [f"property float {name}" for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")]
PLY += [f"property float scale_{axis}" for axis in range(3)]
PLY += [*(f"property float rot_{axis}" for axis in range(4)), "end_header"]


def sog_bytes(count: int, **files: bytes) -> bytes:
    return zipped(meta__json=json.dumps(sog_meta(count)).encode(), **files)


BOMBS = {
    "a.spz": lambda: spz_bytes(HUGE, body=bytes(1000)),
    "zeros.spz": lambda: gzip.compress(bytes(60_000_000)),
    "long.spz": lambda: spz_bytes(3_000_000, body=bytes(60_000_000)),
    "b.spz": lambda: spz4_bytes(HUGE),
    "c.ksplat": lambda: ksplat_bytes(HUGE),
    "sections.ksplat": lambda: ksplat_bytes(3, sections=HUGE),
    "d.glb": lambda: glb_bytes(splat_gltf(HUGE), bytes(1000)),
    "e.sog": lambda: sog_bytes(HUGE),
    "image.sog": lambda: sog_bytes(4, means_l__webp=webp_announcing(16384, 16384)),
    "zip.sog": lambda: sog_bytes(4, means_l__webp=bytes(60_000_000)),
    "meta.sog": lambda: zipped(meta__json=b" " * 60_000_000),
    "deep.sog": lambda: zipped(meta__json=b"[" * 1_000_000),
    "deep.gltf": lambda: b"[" * 1_000_000,
    "f.ply": lambda: "\n".join([*PLY, ""]).encode() + bytes(1000),
}
"""Made when they are needed: some take a moment."""


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_take_little_memory(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(BOMBS[name]())
    assert memory_of(path) <= 40e6
    refusal(path)


def test_what_unpacks_to_a_multiple_of_its_size_stays_within_the_stated_bound(tmp_path):
    """Equal splats shrink to a hundredth: small files may do so, larger ones may not."""
    few, many = FREE_BYTES // 400, FREE_BYTES // 20
    path = tmp_path / "a.spz"
    path.write_bytes(spz_bytes(few, body=bytes(65 * few)))
    assert read_splats(path).total == few
    path.write_bytes(spz_bytes(many, body=bytes(65 * many)))
    assert path.stat().st_size * EXPANSION < 236 * many - FREE_BYTES
    assert "made to fill the memory" in refusal(path)


NAN = {"codebook": [float("nan")] * 256, "files": ["sh0.webp"]}
GONE = {"asset": {"version": "2.0"}, "buffers": [{"uri": "gone.bin", "byteLength": 3}]}
WRONG = {
    "magic.spz": (b"PSGN" * 20, "damaged"),
    "five.spz": (spz_bytes(3, version=5), "version 5, and 1 to 4"),
    "nine.spz": (b"NGSP" + struct.pack("<I", 9) + bytes(100), "version 9, and 1 to 4"),
    "degree.spz": (spz_bytes(3, degree=7), "degree 7"),
    "none.spz": (spz_bytes(0), "has no splats"),
    "short.spz": (spz_bytes(3, body=bytes(20)), "cut off"),
    "ply.spz": (gzip.compress(b"ply\nformat ascii 1.0\n"), "unpack it and import the .ply"),
    "none.splat": (b"", "has no splats"),
    "negative.splat": (np.full(8, -1, "<f4").tobytes() * 3, "negative scales"),
    "one.ksplat": (b"\1\0" + bytes(5000), "1.0, level 0"),
    "level.ksplat": (struct.pack("<BB18xH", 0, 1, 3).ljust(6000, b"\0"), "level 3"),
    "none.ksplat": (ksplat_bytes(0), "has no splats"),
    "zip.sog": (zipped(a__txt=b"x"), "no meta.json, so it is no .sog"),
    "one.sog": (zipped(meta__json=b"{}"), "without a version"),
    "three.sog": (zipped(meta__json=b'{"version": 3}'), "version 3, and version 2 is read"),
    "list.sog": (zipped(meta__json=b"[]"), "no object"),
    "count.sog": (zipped(meta__json=b'{"version": 2, "count": -1}'), "no count"),
    "lacks.sog": (zipped(meta__json=json.dumps(sog_meta(3)).encode()), "lacks 'means_l.webp'"),
    "part.sog": (zipped(meta__json=json.dumps(sog_meta(3, quats=None)).encode()), "no 'quats'"),
    "nan.sog": (zipped(meta__json=json.dumps(sog_meta(3, sh0=NAN)).encode()), "256 numbers"),
    "one.glb": (b"glTF" + struct.pack("<II", 1, 12), "version 1, and version 2"),
    "mesh.glb": (glb_bytes({"meshes": [{"primitives": [{"attributes": {}}]}]}), "no Gaussian splats"),
    "out.glb": (glb_bytes(splat_gltf(500), bytes(1000)), "lies outside of its buffer"),
    "circle.glb": (glb_bytes({"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}), "circle"),
    "sheared.glb": (
        glb_bytes({**splat_gltf(3), "nodes": [{"mesh": 0, "scale": [1, 2, 1]}]}, np.ones(250, "<f4").tobytes()),
        "apply its scale",
    ),
    "file.gltf": (json.dumps(GONE).encode(), "lacks 'gone.bin'"),
    "a.usd": (b"PXR-USDC", "Blender 5.3"),
    "a.usdz": (zipped(a__usdc=b"x"), "Blender 5.3"),
    "a.las": (b"LASF", "point cloud"),
    "a.obj": (b"v 0 0 0", "a mesh"),
    "a.fbx": (b"Kaydara FBX Binary", "a mesh"),
    "a.lcc": (b"{}", "splat-transform"),
    "a.html": (b"<html>", "SuperSplat"),
    "a.ckpt": (zipped(a__pkl=b"x"), "ns-export"),
    "lod-meta.json": (b"{}", "splat-transform"),
    "a.xyzw": (b"?", "splat-transform"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_named_with_the_reason(tmp_path, name):
    data, words = WRONG[name]
    (tmp_path / name).write_bytes(data)
    assert words in refusal(tmp_path / name)


@pytest.mark.parametrize("outside", ["../secret.webp", "/etc/passwd", "a/../../secret.webp", "C:secret.webp", "..", ""])
@pytest.mark.parametrize("packed", [True, False])
def test_a_sog_names_no_files_elsewhere(tmp_path, outside, packed):
    (tmp_path / "secret.webp").write_bytes(b"secret")
    meta = json.dumps(sog_meta(3, quats={"files": [outside]})).encode()
    folder = tmp_path / "folder"
    folder.mkdir()
    path = folder / ("a.sog" if packed else "meta.json")
    path.write_bytes(zipped(meta__json=meta) if packed else meta)
    assert "which is not one beside it" in refusal(path)


@pytest.mark.parametrize("outside", ["../secret.bin", "%2e%2e/secret.bin", "/etc/passwd", "file:///etc", "http://x/a"])
def test_a_gltf_names_no_files_elsewhere(tmp_path, outside):
    (tmp_path / "secret.bin").write_bytes(bytes(1000))
    folder = tmp_path / "folder"
    folder.mkdir()
    document = {"asset": {"version": "2.0"}, **splat_gltf(3), "buffers": [{"uri": outside, "byteLength": 1000}]}
    (folder / "a.gltf").write_text(json.dumps(document))
    assert "which is not one beside it" in refusal(folder / "a.gltf")


def test_a_gltf_may_hold_its_buffer_itself(tmp_path):
    uri = "data:application/octet-stream;base64," + base64.b64encode(np.ones(250, "<f4").tobytes()).decode()
    document = {"asset": {"version": "2.0"}, **splat_gltf(3), "buffers": [{"uri": uri, "byteLength": 1000}]}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    np.testing.assert_array_equal(read_splats(tmp_path / "a.gltf").cloud.means, np.ones((3, 3)))


def test_a_folder_that_lacks_an_image_is_named(tmp_path):
    FORMATS["sog"].write(tmp_path / "meta.json", random_cloud(20, 1))
    assert read_splats(tmp_path).total == 20
    (tmp_path / "shN_labels.webp").unlink()
    assert "lacks 'shN_labels.webp'" in refusal(tmp_path / "meta.json")


def test_a_flipped_bit_in_a_packed_file_is_seen(tmp_path, whole):
    """gzip and zip have check sums over all that they hold."""
    for name in ("spz", "sog"):
        data = bytearray(whole[name].read_bytes())
        data[len(data) // 2] ^= 1
        path = tmp_path / whole[name].name
        path.write_bytes(data)
        refusal(path)


@pytest.mark.parametrize("name", ["splat", "ksplat", "gltf", "ply"])
def test_invalid_splats_are_refused_or_left_out(tmp_path, name):
    """NaN, infinite values and quaternions of norm 0, in formats that can hold them."""
    suffix, write = WRITERS[name]
    cloud = random_cloud(50, 0)
    cloud.means[7] = np.nan
    cloud.scales[20] = np.inf
    cloud.quats[30] = 0.0
    path = tmp_path / f"a{suffix}"
    write(path, cloud)
    assert "3 of 50 splats have NaN, infinite or zero-rotation values" in refusal(path)
    loaded = read_splats(path, drop_invalid=True)
    assert loaded.dropped == 3
    np.testing.assert_array_equal(loaded.kept, np.delete(np.arange(50), [7, 20, 30]))
    np.testing.assert_array_equal(loaded.cloud.means, cloud.means[loaded.kept])


def test_parts_of_different_degrees_are_joined(tmp_path):
    """Two primitives of a .gltf; what the one lacks is 0, as it looks the same."""
    first, second = random_cloud(5, 0, 1), random_cloud(4, 2, 2)
    documents = []
    for name, cloud in (("a", first), ("b", second)):
        write_gltf(tmp_path / f"{name}.gltf", cloud)
        documents.append(json.loads((tmp_path / f"{name}.gltf").read_text()))
    a, b = documents
    shift = len(a["accessors"])
    for accessor in b["accessors"]:
        accessor["bufferView"] += shift
    for view in b["bufferViews"]:
        view["buffer"] = 1
    for names in (primitive["attributes"] for primitive in b["meshes"][0]["primitives"]):
        names.update({name: place + shift for name, place in names.items()})
    for key in ("accessors", "bufferViews", "buffers"):
        a[key] += b[key]
    a["meshes"].append(b["meshes"][0])
    a["nodes"] = [{"mesh": 0}, {"children": [2], "translation": [0, 0, 1]}, {"mesh": 1, "scale": [2, 2, 2]}]
    a["scenes"] = [{"nodes": [0, 1]}]
    (tmp_path / "both.gltf").write_text(json.dumps(a))
    cloud = read_splats(tmp_path / "both.gltf").cloud
    assert cloud.sh_degree == 2
    np.testing.assert_array_equal(cloud.sh[:5, 1:], 0.0)
    np.testing.assert_array_equal(cloud.sh[5:], second.sh)
    np.testing.assert_array_equal(cloud.means[:5], first.means)
    np.testing.assert_allclose(cloud.means[5:], 2.0 * second.means + [0, 0, 1], rtol=1e-6)
    np.testing.assert_allclose(cloud.scales[5:], 2.0 * second.scales, rtol=1e-6)


def test_half_a_band_of_harmonics_is_refused(tmp_path):
    write_gltf(tmp_path / "a.gltf", random_cloud(5, 1))
    document = json.loads((tmp_path / "a.gltf").read_text())
    del document["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert "not whole bands" in refusal(tmp_path / "a.gltf")


def test_without_zstandard_a_sentence_says_what_helps(tmp_path, whole, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    monkeypatch.setitem(sys.modules, "compression.zstd", None)
    with pytest.raises(InputError, match=r"zstandard.* use Blender 4\.3 or later"):
        read_splats(whole["spz 4"])
    with pytest.raises(InputError, match=r"zstandard"):
        write_spz(tmp_path / "a.spz", random_cloud(3, 0), version=4)
    assert not list(tmp_path.iterdir())


def test_the_order_of_a_failed_write_is_kept(tmp_path):
    """What was there stays, for every format."""
    cloud = random_cloud(3, 0)
    write_ply(tmp_path / "a.ply", cloud)
    before = (tmp_path / "a.ply").read_bytes()
    broken = replace(cloud, means=np.full((3, 3), 1e30))
    (tmp_path / "a.spz").write_bytes(b"mine")
    with pytest.raises(InputError, match="too far"):
        write_spz(tmp_path / "a.spz", broken)
    assert (tmp_path / "a.spz").read_bytes() == b"mine"
    assert (tmp_path / "a.ply").read_bytes() == before
