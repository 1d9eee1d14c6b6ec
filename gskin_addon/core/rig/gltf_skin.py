# SPDX-License-Identifier: GPL-3.0-or-later
"""Skin weights of a .glb or .gltf file: of its meshes, and of the splats that `scene/gltf_export.py` wrote. numpy only.

Sections of glTF 2.0: 3.7.2 (primitives), 3.7.3 (skins).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..splats.axes import up_rotation
from ..splats.gltf import EXTENSION_NAME
from ..splats.gltf_container import GltfFile, read_container
from ..splats.gltf_file import node_matrices, node_matrix
from ..splats.loaded import damaged

Array = NDArray[Any]

_CELLS = 400_000_000
"""Weights, vertices times joints, that a file may unpack to."""


@dataclass(frozen=True, eq=False)
class Skinned:
    """verts (V, 3) float64 at rest, z up; faces (F, 3) int64; weights (V, B) float32, rows sum to 1 or are 0; bones: B
    names."""

    verts: Array
    faces: Array
    weights: Array
    bones: tuple[str, ...]


def read_gltf_skin(path: Path, *, splats: bool = False) -> Skinned:
    """All skinned meshes of the file's default scene as one, or its skinned splats (without faces).

    Raises InputError: no glTF, damaged, cut off, nothing skinned in it, compressed, other primitives than triangles.
    """
    file = read_container(path)
    scene = [node for node, _ in node_matrices(file)]
    parts = [part for node in scene for part in _parts(file, node, splats)]
    if not parts:
        what = "skinned splats" if splats else "skinned mesh"
        raise InputError(f"'{path}' has no {what} in its scene; choose a file whose objects follow an armature.")
    nodes = file.items("nodes")
    joints = list(dict.fromkeys(joint for part in parts for joint in part.joints))
    total = sum(part.count for part in parts)
    if total * len(joints) > _CELLS:
        raise InputError(
            f"'{path}' has {total:,} vertices for {len(joints):,} joints, more weights than fit in memory; leave out "
            "joints that move nothing."
        )
    place = {joint: column for column, joint in enumerate(joints)}
    inverses = [part.inverse() for part in parts]
    rests = _rests(file, scene, inverses)
    verts, weights = np.zeros((total, 3)), np.zeros((total, len(joints)), np.float32)
    faces, start = [np.zeros((0, 3), np.int64)], 0
    turn = up_rotation("y")
    for part, inverse in zip(parts, inverses, strict=True):
        rows = slice(start, start + part.count)
        matrix = part.rest(rests, inverse)
        verts[rows] = (part.attribute("POSITION", 3) @ matrix[:3, :3].T + matrix[:3, 3]) @ turn.T
        part.add_weights(weights[rows], np.array([place[joint] for joint in part.joints]))
        faces.append(part.faces() + start)
        start += part.count
    if not np.isfinite(verts).all():
        raise damaged(path, "vertices that are not finite")
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
    return Skinned(verts, np.concatenate(faces), weights, _names(nodes, joints))


@dataclass(frozen=True)
class _Part:
    """A skinned primitive: its JSON, and that of its skin."""

    file: GltfFile
    primitive: Mapping[str, Any]
    skin: Mapping[str, Any]
    joints: tuple[int, ...]
    count: int

    def attribute(self, name: str, width: int, *, whole: bool = False) -> Array:
        """The values (V, width) of an attribute."""
        index = self.primitive["attributes"].get(name)
        values = self.file.accessor(index, whole=whole)
        if values.shape != (self.count, width):
            raise damaged(self.file.path, f"its {name} has the shape {values.shape} for {self.count} vertices")
        return values

    def inverse(self) -> dict[int, Array]:
        """Of each joint the inverse bind matrix (4, 4): from the vertices to the joint."""
        if "inverseBindMatrices" not in self.skin:
            return dict.fromkeys(self.joints, np.eye(4))
        every = self.file.accessor(self.skin["inverseBindMatrices"])
        if every.ndim != 2 or every.shape[1] != 16 or len(every) < len(self.joints):
            raise damaged(self.file.path, "its inverse bind matrices are no matrices of all joints")
        matrices = every[: len(self.joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)
        return dict(zip(self.joints, matrices, strict=True))

    def rest(self, rests: Mapping[int, Array], inverse: Mapping[int, Array]) -> Array:
        """The matrix (4, 4) from the vertices to the scene, at rest, from `_rests` and `inverse`."""
        joint = next((node for node in rests if node in self.joints), None)  # none of the skin is above it
        if joint is None:
            raise damaged(self.file.path, f"joint {self.joints[0]} is not in its scene")
        return rests[joint] @ inverse[joint]

    def add_weights(self, out: Array, columns: Array) -> None:
        """Add the weights to out (V, B); columns (J,) of the joints."""
        number = 0
        while f"JOINTS_{number}" in self.primitive["attributes"]:
            joint = self.attribute(f"JOINTS_{number}", 4, whole=True).astype(np.int64)
            weight = np.asarray(self.attribute(f"WEIGHTS_{number}", 4), np.float32)
            if not np.isfinite(weight).all() or (weight < 0).any():
                raise damaged(self.file.path, "weights that are negative or not finite")
            if self.count and joint[weight > 0].max(initial=0) >= len(columns):
                raise damaged(self.file.path, f"a vertex of a joint that its skin of {len(columns)} does not have")
            joint = np.minimum(joint, len(columns) - 1)
            for k in range(4):
                np.add.at(out, (np.arange(self.count), columns[joint[:, k]]), weight[:, k])
            number += 1

    def faces(self) -> Array:
        """Triangles (F, 3); none of splats."""
        if self.primitive.get("mode", 4) == 0:
            return np.zeros((0, 3), np.int64)
        if "indices" in self.primitive:
            index = self.file.accessor(self.primitive["indices"], whole=True).astype(np.int64)
        else:
            index = np.arange(self.count)
        if index.ndim != 1 or len(index) % 3 or index.max(initial=0) >= max(self.count, 1):
            raise damaged(self.file.path, "its triangles are not three vertices each that exist")
        return index.reshape(-1, 3)


def _rests(file: GltfFile, nodes: Iterable[int], skins: list[dict[int, Array]]) -> dict[int, Array]:
    """Where nodes are when the joints are at rest: matrices (4, 4) to the scene, in the order of `nodes`.

    nodes: those of the scene, parents first; skins: of each, the inverse bind matrices by joint.
    Each joint lies to the next one of its skin above it as it did when the mesh was bound: both take the vertices to
    the same place (glTF 2.0, 3.7.3.3). That says nothing of topmost joints: with their nodes the file says in which
    unit, which way up and where its scene has the mesh, and Blender's importer takes it so, too.
    """
    above = {child: node for node in nodes for child in file.item("nodes", node).get("children", ())}
    rests: dict[int, Array] = {}
    for node in nodes:
        parent = above.get(node)
        rests[node] = node_matrix(file, file.item("nodes", node))
        if parent is not None:
            rests[node] = rests[parent] @ rests[node]
        for inverse in skins:
            joint = parent if node in inverse else None
            while joint is not None and joint not in inverse:
                joint = above.get(joint)
            if joint is not None:
                try:
                    rests[node] = rests[joint] @ inverse[joint] @ np.linalg.inv(inverse[node])
                except np.linalg.LinAlgError:
                    raise damaged(file.path, "an inverse bind matrix that cannot be inverted") from None
                break
    return rests


def _parts(file: GltfFile, node: int, splats: bool) -> Iterator[_Part]:
    """The skinned primitives of a node."""
    table = file.item("nodes", node)
    if "mesh" not in table or "skin" not in table:
        return
    skin = file.item("skins", table["skin"])
    joints = skin.get("joints")
    nodes = len(file.items("nodes"))
    if not isinstance(joints, list) or not joints or not all(type(j) is int and 0 <= j < nodes for j in joints):
        raise damaged(file.path, "the joints of a skin are no nodes")
    primitives = file.item("meshes", table["mesh"]).get("primitives")
    if not isinstance(primitives, list) or not all(isinstance(each, dict) for each in primitives):
        raise damaged(file.path, "primitives are no list")
    for primitive in primitives:
        extensions, attributes = primitive.get("extensions") or {}, primitive.get("attributes")
        if not isinstance(extensions, dict) or not isinstance(attributes, dict):
            raise damaged(file.path, "a primitive has no attributes")
        if (EXTENSION_NAME in extensions) != splats or "JOINTS_0" not in attributes:
            continue
        if "KHR_draco_mesh_compression" in extensions:
            raise InputError(f"'{file.path}' is compressed by Draco, which is not read; export it without.")
        if not splats and primitive.get("mode", 4) != 4:
            raise InputError(f"'{file.path}' has a skinned mesh that is not of triangles; export it as triangles.")
        count = len(file.accessor(attributes.get("POSITION")))  # as many as the file really has
        yield _Part(file, primitive, skin, tuple(joints), count)


def _names(nodes: list[dict[str, Any]], joints: list[int]) -> tuple[str, ...]:
    """The joints' names; where two have the same, or none, numbered as Blender's importer does."""
    taken: dict[str, int] = {}
    found = []
    for joint in joints:
        name = str(nodes[joint].get("name") or f"Node_{joint}")
        number = taken.get(name, 0)
        taken[name] = number + 1
        found.append(f"{name}.{number:03d}" if number else name)
    return tuple(found)
