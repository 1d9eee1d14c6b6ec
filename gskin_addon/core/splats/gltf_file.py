# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write splats in .glb and .gltf files: primitives with KHR_gaussian_splatting (`gltf.py` has its attributes).

Reading joins all splats of the default scene in the scene's axes (y up). Nodes move them; a skin does not: what it
deforms comes at rest. Rigged files are written by `scene/gltf_export.py`.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_atomically
from .axes import rotate_cloud
from .cloud import MAX_SH_DEGREE, SH_C0, AnyArray, SplatCloud
from .gltf import (
    EXTENSION,
    EXTENSION_NAME,
    MAX_GLTF_SH_DEGREE,
    OFFSET_EXTRAS_NAME,
    encode_attributes,
    fallback_color,
    linear_to_srgb,
    sh_attribute,
)
from .gltf_container import GltfFile, read_container
from .loaded import LoadedSplats, Reading, check_count, damaged, empty_splats, finish, finite_rows, pieces, with_degree
from .ply_codec import decode_quats
from .similarity import rigid_part
from .spz import read_spz_stream

UP = "y"
"""By the format's own rules."""

_SPZ = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
_LINEAR = "lin_rec709_display"
_DEEPEST = 200

Part = tuple[SplatCloud, NDArray[np.bool_]]
"""Splats of one primitive, and True (N,) where a splat is valid."""


@dataclass(frozen=True)
class _Primitive:
    """A primitive that holds splats, where its node puts it (4 x 4), and its offset (3,), see `SplatCloud`."""

    attributes: Mapping[str, Any]
    extension: Mapping[str, Any]
    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]


def read_gltf(path: Path, drop_invalid: bool) -> Reading:
    """Read the splats of a .glb or .gltf file piece by piece, with its own axes (y up).

    Raises InputError: damaged, cut off, no splats in it, a kernel or a compression that is not known, nodes that shear
    or mirror splats, invalid splats.
    """
    file = read_container(path)
    found = list(_primitives(file))
    if not found:
        raise InputError(
            f"'{path}' has no Gaussian splats ({EXTENSION_NAME}) in its scene; choose a file with splats, or import it "
            "as a mesh or an armature with File > Import > glTF."
        )
    parts: list[Part] = []
    total = 0
    for number, primitive in enumerate(found):
        compressed = _compressed(file, primitive)
        if compressed is None:
            total += _count(file, primitive)
            degree = _degree(file, primitive)
            check_count(path, total, degree, file.size)
            steps = _read_primitive(file, primitive, degree)
        else:
            steps = _read_compressed(file, compressed)
        cloud, valid = yield from _shares(steps, number, len(found))
        parts.append((_placed(path, cloud, primitive), valid))
    cloud = yield from _joined([cloud for cloud, _ in parts])
    valid = np.concatenate([valid for _, valid in parts])
    return (yield from finish(path, cloud, valid, drop_invalid))


def _shares(steps: Generator[float, None, Part], number: int, count: int) -> Generator[float, None, Part]:
    """The steps of one of `count` parts as shares of the whole."""
    while True:
        try:
            done = next(steps)
        except StopIteration as stop:
            result: Part = stop.value
            return result
        yield (number + done) / count


def node_matrices(file: GltfFile) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """The nodes of the default scene (all where there is no scene), by number, and their matrices (4, 4) in the world.

    Raises InputError: a node that does not exist, hangs in a circle or in two places.
    """
    nodes = file.items("nodes")
    scenes = file.items("scenes")
    if scenes:
        roots = file.item("scenes", file.json.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in _list(file, node, "children")}
        roots = [index for index in range(len(nodes)) if index not in children]
    seen: set[int] = set()
    stack = [(index, np.eye(4), 0) for index in reversed(roots)]
    while stack:
        index, parent, depth = stack.pop()
        node = file.item("nodes", index)
        if index in seen or depth > _DEEPEST:
            raise damaged(file.path, f"its node {index} hangs in a circle, or in two places")
        seen.add(index)
        matrix = parent @ node_matrix(file, node)
        stack += [(child, matrix, depth + 1) for child in reversed(_list(file, node, "children"))]
        yield index, matrix


def _primitives(file: GltfFile) -> Iterator[_Primitive]:
    """The primitives with splats of the default scene, with their places."""
    for index, matrix in node_matrices(file):
        node = file.item("nodes", index)
        if "mesh" not in node:
            continue
        for primitive in _list(file, file.item("meshes", node["mesh"]), "primitives"):
            extension = _table(primitive, "extensions").get(EXTENSION_NAME)
            if isinstance(extension, dict):
                kernel = extension.get("kernel", "ellipse")
                if kernel != "ellipse":
                    raise InputError(f"'{file.path}' has splats with the kernel {kernel!r:.40}, which are not read.")
                # A skin alone says where what it deforms is; its node does not move it (glTF 2.0, 3.7.3.3).
                place = np.eye(4) if "skin" in node else matrix
                names = {str(name).upper(): value for name, value in _table(primitive, "attributes").items()}
                yield _Primitive(names, extension, place, _offset(_table(primitive, "extras")))


def _offset(extras: Mapping[str, Any]) -> NDArray[np.float64]:
    """The offset that `scene/gltf_export.py` has noted; zeros where there is none."""
    try:
        offset = np.array(extras.get(OFFSET_EXTRAS_NAME, (0.0, 0.0, 0.0)), np.float64)
    except (TypeError, ValueError):
        offset = np.empty(0)
    return offset if offset.shape == (3,) and np.isfinite(offset).all() else np.zeros(3)


def _table(parent: Any, key: str) -> Mapping[str, Any]:
    value = parent.get(key) if isinstance(parent, dict) else None
    return value if isinstance(value, dict) else {}


def _list(file: GltfFile, parent: Mapping[str, Any], key: str) -> list[Any]:
    value = parent.get(key, [])
    if not isinstance(value, list):
        raise damaged(file.path, f"{key} are no list")
    return value


def node_matrix(file: GltfFile, node: Mapping[str, Any]) -> NDArray[np.float64]:
    """The matrix of a node, 4 x 4, from its matrix or its translation, rotation (xyzw) and scale."""

    def numbers(key: str, default: list[float]) -> NDArray[np.float64]:
        value = node.get(key, default)
        try:
            found = np.array(value, np.float64)
        except (TypeError, ValueError):
            found = np.empty(0)
        if found.shape != (len(default),) or not np.isfinite(found).all():
            raise damaged(file.path, f"the {key} of a node is not {len(default)} numbers")
        return found

    if "matrix" in node:
        return numbers("matrix", np.eye(4).reshape(-1).tolist()).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix[:3, :3] = rotation * numbers("scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = numbers("translation", [0.0, 0.0, 0.0])
    return matrix


def _compressed(file: GltfFile, primitive: _Primitive) -> NDArray[np.uint8] | None:
    """The bytes of the .spz within the primitive; None where its attributes are plain."""
    extensions = _table(primitive.extension, "extensions")
    for name in extensions:
        if name not in _SPZ:
            raise InputError(
                f"'{file.path}' has splats compressed by {name!r:.60}, which is not read; export it uncompressed."
            )
        return file.view_bytes(_table(extensions, name).get("bufferView"))
    return None


def _read_compressed(file: GltfFile, data: NDArray[np.uint8]) -> Generator[float, None, Part]:
    loaded: LoadedSplats = yield from read_spz_stream(io.BytesIO(data.tobytes()), len(data), file.path, True)
    if loaded.dropped:
        raise damaged(file.path, f"{loaded.dropped} of its compressed splats are invalid")
    return loaded.cloud, np.ones(loaded.total, bool)


def _count(file: GltfFile, primitive: _Primitive) -> int:
    count = file.item("accessors", primitive.attributes.get("POSITION")).get("count")
    if type(count) is not int or count < 0:
        raise damaged(file.path, f"a primitive of {count!r:.20} splats")
    return count


def _degree(file: GltfFile, primitive: _Primitive) -> int:
    """The degree of the harmonics; InputError where a band is not whole."""
    present = [sh_attribute(index).upper() in primitive.attributes for index in range((MAX_SH_DEGREE + 1) ** 2)]
    known = sum(present)
    degree = round(known**0.5) - 1
    if known != (degree + 1) ** 2 or not all(present[:known]):
        raise damaged(file.path, "its harmonics are not whole bands")
    return degree


def _read_primitive(file: GltfFile, primitive: _Primitive, degree: int) -> Generator[float, None, Part]:
    """The splats of plain attributes."""
    count = _count(file, primitive)

    def attribute(name: str, width: int) -> AnyArray:
        index = primitive.attributes.get(name.upper())
        if index is None:
            raise damaged(file.path, f"its splats have no {name}")
        values = file.accessor(index)
        if values.shape != ((count,) if width == 1 else (count, width)):
            raise damaged(file.path, f"its {name} has the shape {values.shape} for {count} splats")
        return values

    means = attribute("POSITION", 3)
    quats = attribute(f"{EXTENSION_NAME}:ROTATION", 4)
    scales = attribute(f"{EXTENSION_NAME}:SCALE", 3)
    opacities = attribute(f"{EXTENSION_NAME}:OPACITY", 1)
    sh = [attribute(sh_attribute(index), 3) for index in range((degree + 1) ** 2)]
    linear = primitive.extension.get("colorSpace") == _LINEAR
    cloud = empty_splats(count, degree, UP)
    if linear:
        cloud = replace(cloud, notes=("its linear colours were made sRGB, view-dependent ones to first order",))
    valid = np.empty(count, bool)
    for rows in pieces(count):
        cloud.means[rows] = means[rows]
        cloud.quats[rows] = decode_quats(np.roll(quats[rows], 1, axis=1))
        cloud.scales[rows] = scales[rows]
        cloud.opacities[rows] = np.clip(opacities[rows], 0.0, 1.0)
        for index, values in enumerate(sh):
            cloud.sh[rows, index] = values[rows]
        if linear:
            _to_srgb(cloud, rows)
        valid[rows] = finite_rows(cloud, rows) & (cloud.scales[rows] >= 0.0).all(axis=1)
        yield rows.stop / count
    return cloud, valid


def _to_srgb(cloud: SplatCloud, rows: slice) -> None:
    """Linear colours to sRGB: the constant harmonic exactly, the others by the curve's slope there."""
    value = 0.5 + SH_C0 * cloud.sh[rows, 0].astype(np.float64)
    step = 1e-4
    slope = (linear_to_srgb(value + step) - linear_to_srgb(value - step)) / (2.0 * step)
    cloud.sh[rows, 1:] *= slope[:, None].astype(np.float32)
    cloud.sh[rows, 0] = (linear_to_srgb(value) - 0.5) / SH_C0


def _placed(path: Path, cloud: SplatCloud, primitive: _Primitive) -> SplatCloud:
    """The splats where their node puts them."""
    cloud = replace(cloud, offset=primitive.offset)
    if np.array_equal(primitive.matrix, np.eye(4)):
        return cloud
    found = rigid_part(primitive.matrix[:3, :3])
    if found is None:
        raise InputError(
            f"'{path}' has splats below a node that mirrors, shears or stretches them, which they cannot follow; "
            "apply its scale before exporting."
        )
    rotation, scale = found
    turned = rotate_cloud(cloud, rotation)
    means = turned.means * np.float32(scale) + primitive.matrix[:3, 3].astype(np.float32)
    return replace(turned, means=means, scales=turned.scales * np.float32(scale), up=UP)


def _joined(clouds: list[SplatCloud]) -> Generator[float, None, SplatCloud]:
    """One cloud of several; harmonics that one lacks are 0."""
    if len(clouds) == 1:
        return clouds[0]
    degree = max(cloud.sh_degree for cloud in clouds)
    whole = empty_splats(sum(cloud.count for cloud in clouds), degree, UP)
    start = 0
    for cloud in clouds:
        for rows in pieces(cloud.count):
            there = slice(start + rows.start, start + rows.stop)
            for name in ("means", "quats", "scales", "opacities"):
                getattr(whole, name)[there] = getattr(cloud, name)[rows]
            whole.sh[there, : cloud.sh.shape[1]] = cloud.sh[rows]
            whole.sh[there, cloud.sh.shape[1] :] = 0.0
            yield 1.0
        start += cloud.count
    offset = clouds[0].offset
    if any((cloud.offset != offset).any() for cloud in clouds):
        offset = np.zeros(3)  # parts of different places: as they stand
    return replace(whole, offset=offset, notes=tuple(dict.fromkeys(note for cloud in clouds for note in cloud.notes)))


def write_gltf(path: Path, cloud: SplatCloud) -> None:
    """Write a cloud in glTF's axes (y up) as one primitive: a .glb, or for a path that ends in .gltf that and a .bin.

    Harmonics above degree 3 are lost.
    """
    cloud = with_degree(cloud, MAX_GLTF_SH_DEGREE)
    arrays: dict[str, AnyArray] = {"POSITION": np.ascontiguousarray(cloud.means), **encode_attributes(cloud)}
    arrays["COLOR_0"] = fallback_color(cloud)
    text = path.suffix.lower() == ".gltf"
    document, size = _document(arrays)
    if text:
        binary = path.with_suffix(".bin")
        document["buffers"][0]["uri"] = binary.name

    def write_arrays(file: BinaryIO) -> None:
        for values in arrays.values():
            file.write(np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False)).data)

    def write_glb(file: BinaryIO) -> None:
        data = json.dumps(document, separators=(",", ":")).encode()
        data += b" " * (-len(data) % 4)
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(data) + size))
        file.write(struct.pack("<I4s", len(data), b"JSON") + data)
        file.write(struct.pack("<I4s", size, b"BIN\0"))
        write_arrays(file)

    if text:
        write_atomically(binary, write_arrays)
        write_atomically(path, lambda file: file.write(json.dumps(document, indent=1).encode()))
    else:
        write_atomically(path, write_glb)


def _document(arrays: Mapping[str, AnyArray]) -> tuple[dict[str, Any], int]:
    """The JSON of one primitive with these attributes, one after the other in one buffer; and the buffer's bytes."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    size = 0
    for name, values in arrays.items():
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": 5123 if values.dtype == np.uint16 else 5126,
            "count": len(values),
            "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
        }
        if values.dtype == np.uint16:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor["min"], accessor["max"] = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes, "target": 34962})
        accessors.append(accessor)
        size += values.nbytes
    primitive = {
        "attributes": {name: index for index, name in enumerate(arrays)},
        "mode": 0,
        "extensions": {EXTENSION_NAME: dict(EXTENSION)},
    }
    document = {
        "asset": {"version": "2.0", "generator": "gskin"},
        "extensionsUsed": [EXTENSION_NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    return document, size
