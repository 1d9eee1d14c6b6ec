# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes with weights from .glb, .npz and RigNet's text; made-up files that lie about themselves."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from proxy_meshes import tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.job.skinned_files import read_skinned, read_surface
from gskin_addon.core.rig.rignet_file import write_rignet
from gskin_addon.core.rig.skeleton import Skeleton


def body():
    verts, faces = tube(2, 9, 6, 0.2)
    weights = np.stack([2 - verts[:, 0], verts[:, 0]], axis=1).astype(np.float32) / 2
    return verts, faces, weights


def document(verts, faces, weights, scale=0.01):
    """A skinned mesh in centimetres below joints of a hundredth, as Mixamo's are; JSON and binary."""
    arrays = [
        (verts / scale).astype("<f4"), faces.astype("<u2").ravel(), np.tile(np.uint8([1, 0, 0, 0]), (len(verts), 1)),
        np.pad(weights, ((0, 0), (0, 2))).astype("<f4"), np.tile(np.eye(4, dtype="<f4"), (2, 1, 1)),
    ]  # fmt: skip
    kinds = [(5126, "VEC3"), (5123, "SCALAR"), (5121, "VEC4"), (5126, "VEC4"), (5126, "MAT4")]
    views, accessors, binary = [], [], b""
    for array, (code, kind) in zip(arrays, kinds, strict=True):
        binary += b"\0" * (-len(binary) % 4)
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        accessors.append({"bufferView": len(views) - 1, "componentType": code, "count": len(array), "type": kind})
        binary += array.tobytes()
    attributes = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [5, 5, 5]},
            {"name": "up", "scale": [scale] * 3, "children": [2]},
            {"name": "low"},
        ],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": 4}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1}]}],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(binary)}],
    }, binary


def write_glb(path, parsed, binary):
    text = json.dumps(parsed).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def test_a_skinned_glb_stands_in_the_scenes_unit_whatever_its_node_says(tmp_path):
    verts, faces, weights = body()
    mesh = read_skinned(write_glb(tmp_path / "a.glb", *document(verts, faces, weights)))
    np.testing.assert_allclose(mesh.verts, verts[:, [0, 2, 1]] * [1, -1, 1], atol=1e-6)
    assert np.array_equal(mesh.faces, faces)
    assert mesh.bones == ("up", "low")
    np.testing.assert_allclose(mesh.weights, weights[:, ::-1], atol=1e-6)  # the joints of each vertex are 1, 0


def posed(order, second_skin=False):
    """The same with the lower joint 1 m along x from the upper one when it was bound, and raised by 30 degrees since;
    joints in the order given. With a second skin, another mesh follows the lower joint alone."""
    parsed, binary = document(*body())
    bind = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
    bind[order.index(2), 3, 0] = -100  # columns first, in centimetres
    binary = binary[: -bind.nbytes] + bind.tobytes()
    parsed["skins"][0]["joints"] = order
    half = np.radians(15)
    parsed["nodes"][2].update(translation=[100, 0, 0], rotation=[0, 0, float(np.sin(half)), float(np.cos(half))])
    if second_skin:
        binary += bind[order.index(2)].tobytes()
        parsed["buffers"][0]["byteLength"] = len(binary)
        parsed["bufferViews"].append({"buffer": 0, "byteOffset": len(binary) - 64, "byteLength": 64})
        parsed["accessors"].append({"bufferView": 5, "componentType": 5126, "count": 1, "type": "MAT4"})
        parsed["skins"].append({"joints": [2], "inverseBindMatrices": 5})
        primitive = parsed["meshes"][0]["primitives"][0]
        alone = {**primitive, "attributes": {**primitive["attributes"], "JOINTS_0": 6}}
        joints = np.zeros((len(body()[0]), 4), np.uint8)
        parsed["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": joints.nbytes})
        parsed["accessors"].append({"bufferView": 6, "componentType": 5121, "count": len(joints), "type": "VEC4"})
        binary += joints.tobytes()
        parsed["buffers"][0]["byteLength"] = len(binary)
        parsed["meshes"].append({"primitives": [alone]})
        parsed["nodes"].append({"mesh": 1, "skin": 1})
        parsed["scenes"][0]["nodes"].append(3)
    return parsed, binary


@pytest.mark.parametrize("order", [[1, 2], [2, 1]])
def test_a_skinned_glb_is_at_rest_when_its_joints_are_posed(tmp_path, order):
    """The skin's first joint need be neither the topmost one nor at rest."""
    verts, *_ = body()
    mesh = read_skinned(write_glb(tmp_path / "a.glb", *posed(order)))
    np.testing.assert_allclose(mesh.verts, verts[:, [0, 2, 1]] * [1, -1, 1], atol=1e-6)


def test_a_mesh_that_follows_posed_joints_alone_is_at_rest_beside_the_others(tmp_path):
    verts, *_ = body()
    mesh = read_skinned(write_glb(tmp_path / "a.glb", *posed([2, 1], second_skin=True)))
    expected = verts[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(mesh.verts, np.concatenate([expected, expected]), atol=1e-6)


def test_where_the_topmost_joint_is_the_mesh_is_too(tmp_path):
    """As in Blender's importer: files that stand upright only by the turn of this node are common."""
    parsed, binary = document(*body())
    parsed["nodes"][1].update(rotation=[-np.sqrt(0.5), 0, 0, np.sqrt(0.5)], translation=[0, 0, 3])
    mesh = read_skinned(write_glb(tmp_path / "a.glb", parsed, binary))
    verts, *_ = body()
    np.testing.assert_allclose(mesh.verts, verts + [0, -3, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d["accessors"][0].update(count=10**9), "outside of its buffer"),
        (lambda d: d["accessors"][2].update(componentType=5126), "damaged|shape|outside"),
        (lambda d: d["accessors"][1].update(count=7), "three vertices each"),
        (lambda d: d["skins"][0].update(joints=[1, 99]), "no nodes"),
        (lambda d: d["skins"][0].update(joints=[1]), "does not have"),
        (lambda d: d["skins"][0].update(joints="x"), "no nodes"),
        (lambda d: d["nodes"][2].update(children=[1]), "circle"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=5), "export it as triangles"),
        (lambda d: d["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {}}), "Draco"),
        (lambda d: d["meshes"][0].update(primitives=[5]), "no list"),
        (lambda d: d["nodes"][0].pop("skin"), "no skinned mesh"),
    ],
)
def test_damaged_glb_files_are_refused(tmp_path, change, said):
    parsed, binary = document(*body())
    change(parsed)
    path = write_glb(tmp_path / "bad.glb", parsed, binary)
    with pytest.raises(InputError, match=said) as caught:
        read_skinned(path)
    assert str(path) in str(caught.value)


def test_npz_and_rignet_hold_the_same(tmp_path):
    verts, faces, weights = body()
    np.savez(tmp_path / "a.npz", verts=verts, faces=faces, weights=weights, bones=np.array(["up", "low"]))
    row, col = np.nonzero(weights)
    sparse = {"w_row": row, "w_col": col, "w_val": weights[row, col], "bone_names": np.array(["up", "low"])}
    np.savez(tmp_path / "b.npz", verts=verts, faces=faces, **sparse)
    heads = np.array([[0, 0, 0], [1.0, 0, 0]])
    write_rignet(tmp_path / "c.txt", weights, Skeleton(("up", "low"), np.array([-1, 0]), heads, heads + [1, 0, 0]))
    lines = [f"v {x} {z} {-y}" for x, y, z in verts.tolist()]
    lines += [f"f {a}/1 {b}/1/1 {c - len(verts) - 1}" for a, b, c in (faces + 1).tolist()]
    (tmp_path / "c.obj").write_text("\n".join(lines))
    for name in ("a.npz", "b.npz", "c.txt"):
        mesh = read_skinned(tmp_path / name)
        np.testing.assert_allclose(mesh.verts, verts, atol=1e-6)
        assert np.array_equal(mesh.faces, faces)
        np.testing.assert_allclose(mesh.weights, weights, atol=1e-5)
        assert mesh.bones == ("up", "low")
    found = read_surface(tmp_path / "c.obj")
    np.testing.assert_allclose(found[0], verts, atol=1e-6)


def test_what_does_not_fit_is_refused(tmp_path):
    verts, faces, weights = body()
    bones = np.array(["up", "low"])
    for name, arrays, said in (
        ("rows", {"verts": verts, "faces": faces, "weights": weights[:-1], "bones": bones}, "vertices and 2 bones"),
        ("none", {"verts": verts, "faces": faces}, "lacks the array"),
        ("index", {"verts": verts, "faces": faces + 100, "weights": weights, "bones": bones}, "mesh of triangles"),
        ("sign", {"verts": verts, "faces": faces, "weights": -weights, "bones": bones}, "negative"),
    ):
        np.savez(tmp_path / f"{name}.npz", **arrays)
        with pytest.raises(InputError, match=said):
            read_skinned(tmp_path / f"{name}.npz")
    for name, text, said in (
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4", "do not exist"),
        ("b.obj", "v 0 0 0\nf 0 1 1", "does not exist"),
        ("c.obj", "v 0 0\n", "no mesh that can be read"),
        ("d.obj", "v 0 0 0\n", "no faces"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=said):
            read_surface(tmp_path / name)
    with pytest.raises(InputError, match="give one of"):
        read_skinned(tmp_path / "x.fbx")
