# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender's importer is given of a .glb."""

from __future__ import annotations

import json
import struct

import pytest

from gskin_addon.scene.gltf_readable import readable


def glb(path, document, binary=b"\1\2\3\4") -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    data = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
    path.write_bytes(data)
    return data


SPLATS = {
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "extensions": {"KHR_gaussian_splatting": {}}}]}],
    "skins": [{"joints": [0], "skeleton": 3}],
}


@pytest.mark.parametrize("skeletons", [True, False])
def test_splats_are_points_and_skins_keep_their_root_where_asked(skeletons, tmp_path):
    before = glb(tmp_path / "a.glb", SPLATS)
    with readable(tmp_path / "a.glb", skeletons=skeletons) as copy:
        data = copy.read_bytes()
        assert copy.name == "a.glb"
    size = int.from_bytes(data[12:16], "little")
    assert int.from_bytes(data[8:12], "little") == len(data)
    document = json.loads(data[20 : 20 + size])
    assert document["meshes"][0]["primitives"][0] == {"attributes": {"POSITION": 0}, "extensions": {}}
    assert ("skeleton" in document["skins"][0]) == skeletons
    assert data[20 + size :] == before[-12:]
    assert (tmp_path / "a.glb").read_bytes() == before
    assert not copy.exists()


@pytest.mark.parametrize(
    "document",
    [{"meshes": []}, {}, b"[]", b"{", b'{"meshes": 1}', b'{"meshes": [{}]}', b"[" * 100_000, b"\xff\xfe\0\0"],
    ids=range(8),
)
def test_what_has_nothing_to_leave_out_or_is_damaged_stays_as_it_is(document, tmp_path):
    glb(tmp_path / "a.glb", document)
    for path in (tmp_path / "a.glb", tmp_path / "a.gltf"):
        with readable(path, skeletons=False) as same:
            assert same == path
