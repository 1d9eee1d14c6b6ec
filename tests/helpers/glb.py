# SPDX-License-Identifier: GPL-3.0-or-later
"""A small glTF reader in plain numpy: accessors, node transforms, one animation, skinning, splats."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.gltf import EXTENSION_NAME, sh_attribute

_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        assert data[:4] == b"glTF"
        assert struct.unpack_from("<II", data, 4) == (2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
        size_binary, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert kind == b"BIN\0"
        self.binary = data[28 + size : 28 + size + size_binary]

    def accessor(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype, width = _TYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
        offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(self.binary, dtype, accessor["count"] * width, offset)
        if accessor.get("normalized"):
            values = values / np.iinfo(dtype).max
        return values if width == 1 else values.reshape(-1, width)

    def node(self, name: str) -> int:
        return next(i for i, node in enumerate(self.json["nodes"]) if node.get("name") == name)

    def primitive(self, node: int) -> dict[str, Any]:
        (primitive,) = self.json["meshes"][self.json["nodes"][node]["mesh"]]["primitives"]
        return primitive

    def attributes(self, node: int) -> dict[str, np.ndarray]:
        return {name: self.accessor(index) for name, index in self.primitive(node)["attributes"].items()}

    def joints(self, node: int) -> list[int]:
        return self.json["skins"][self.json["nodes"][node]["skin"]]["joints"]

    def inverse_bind(self, node: int) -> np.ndarray:
        skin = self.json["skins"][self.json["nodes"][node]["skin"]]
        return (
            self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)
        )

    def world(self, time: float | None = None) -> np.ndarray:
        """(nodes, 4, 4) global transforms, at a time of the first animation or at rest."""
        local = [dict(node) for node in self.json["nodes"]]
        if time is not None:
            animation = self.json["animations"][0]
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                value = _sample(self.accessor(sampler["input"]), self.accessor(sampler["output"]), time)
                local[channel["target"]["node"]][channel["target"]["path"]] = value
        matrices = np.array([_matrix(node) for node in local])
        world = np.tile(np.eye(4), (len(local), 1, 1))

        def visit(index: int, parent: np.ndarray) -> None:
            world[index] = parent @ matrices[index]
            for child in self.json["nodes"][index].get("children", ()):
                visit(child, world[index])

        for root in self.json["scenes"][0]["nodes"]:
            visit(root, np.eye(4))
        return world

    def joint_matrices(self, node: int, time: float | None = None) -> np.ndarray:
        """(joints, 4, 4): global transform of each joint times its inverse bind matrix."""
        return self.world(time)[self.joints(node)] @ self.inverse_bind(node)

    def posed(self, node: int, time: float | None = None) -> np.ndarray:
        """Points (N, 3) of a skinned mesh's node as a viewer moves them that reads all sets of joints; z up."""
        found = self.attributes(node)
        joints = np.concatenate([found[name] for name in sorted(found) if name.startswith("JOINTS_")], axis=1)
        weights = np.concatenate([found[name] for name in sorted(found) if name.startswith("WEIGHTS_")], axis=1)
        points = np.c_[found["POSITION"], np.ones(len(joints))]
        moved = np.einsum("nk,nkij,nj->ni", weights, self.joint_matrices(node, time)[joints.astype(int)], points)
        return moved[:, :3] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def decode_attributes(positions: np.ndarray, attributes: dict[str, np.ndarray]) -> SplatCloud:
    """The cloud of the attributes that `encode_attributes` makes."""
    count = sum(name.startswith(f"{EXTENSION_NAME}:SH_DEGREE_") for name in attributes)
    return SplatCloud(
        means=positions,
        quats=np.roll(attributes[f"{EXTENSION_NAME}:ROTATION"], 1, axis=1),
        scales=attributes[f"{EXTENSION_NAME}:SCALE"],
        opacities=attributes[f"{EXTENSION_NAME}:OPACITY"],
        sh=np.stack([attributes[sh_attribute(index)] for index in range(count)], axis=1),
    )


def _sample(times: np.ndarray, values: np.ndarray, time: float) -> np.ndarray:
    """The value at a time that is a key (the exporter writes one per frame), or before or after all keys."""
    index = int(np.clip(np.searchsorted(times, time - 1e-4), 0, len(times) - 1))
    assert len(times) <= 2 or abs(times[index] - time) < 1e-3
    return values[index]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.asarray(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
