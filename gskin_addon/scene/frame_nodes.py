# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes that read off the bone frames (`bone_frames.py`) what each bone, and each joint of a bendy bone, does now."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from ..core.rig.stretch import RIGID
from . import names
from .node_algebra import parts, polar_rotation, vector
from .node_builder import Input, Tree, function_group

VERSION = 2
"""Of the node groups."""
_INFO = {"Geometry": "Geometry", "Rotation": "Rotation", "Transform": "Matrix"}
_UNEVENNESS = {
    **dict.fromkeys("XYZ", "Vector"), "Kind": "Float", "Mirrored": "Float",
    **dict.fromkeys(("X Ahead", "Z Ahead", "Way"), "Vector"),
}  # fmt: skip
"""Kinds of inputs by label."""



def bone_points(tree: Tree, info: Any) -> Any:
    """Points, one per frame, with the bones' turns and maps, made of Object Info's outputs about the frames.

    TURN: the rotation of the bone in the splat object's space. FRAME_MAP: matrix from the frame's own space at rest to
    the splat object's space in the pose; of a joint the second column is the middle of the segment, as a place.
    FRAME_INVERSE: matrix from the splat object's space at rest to the frame's own. FRAME_STRETCH: how far the map is
    from a rotation and from one times a scale (`core.rig.stretch.unevenness`), of a joint how far the segment is from
    moving as one, too; and the map's `core.rig.stretch.size`. FRAME_BEND as on the frames.
    """
    return tree.call(_bones_group(), {label: tree.output(info, label) for label in _INFO})["Points"]


def frame_parts() -> tuple[Callable[[], object], ...]:
    """What builds the groups of `bone_points`, each after those that it uses itself."""
    return _unevenness_group, _bones_group


def _bones_group() -> bpy.types.NodeTree:
    return function_group("GSkin Bones", VERSION, _INFO, {"Points": "Geometry"}, _bone_points)


def _unevenness_group() -> bpy.types.NodeTree:
    return function_group("GSkin Unevenness", VERSION, _UNEVENNESS, {"Stretch": "Vector"}, _unevenness)


def _bone_points(tree: Tree, given: Input) -> dict[str, Any]:
    frames, rest = given("Geometry"), given("Rotation")
    count = tree.math("DIVIDE", tree.domain_size(frames, "MESH"), 4.0)
    points = tree.out("GeometryNodePoints", "Points", {"Count": count})
    index = tree.out("GeometryNodeInputIndex", "Index")
    first = tree.math("MULTIPLY", index, 4.0)

    def sampled(value: Any, offset: float = 0.0, kind: str = "FLOAT_VECTOR") -> Any:
        inputs = {"Geometry": frames, "Value": value, "Index": tree.math("ADD", first, offset)}
        return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    def named(name: str, kind: str = "FLOAT_VECTOR", offset: float = 0.0) -> Any:
        return sampled(tree.attribute(name, kind), offset, kind)

    position = tree.out("GeometryNodeInputPosition", "Position")
    corners = [sampled(position, float(k)) for k in range(4)]
    origin = corners[0]
    away = [tree.vector("SUBTRACT", corner, origin) for corner in corners[1:]]
    inverse_size = tree.math("DIVIDE", 1.0, named(names.FRAME_SIZE, "FLOAT"))
    axes = [tree.scale(way, inverse_size) for way in away]
    kind = named(names.FRAME_JOINT, "FLOAT")
    joint, last = tree.math("GREATER_THAN", kind, 0.5), tree.math("GREATER_THAN", kind, 1.5)
    bend = named(names.FRAME_BEND)
    span = parts(tree, bend)[2]

    frame_axes = named(names.FRAME_AXES, "QUATERNION")
    inputs = {"Translation": named(names.FRAME_ORIGIN), "Rotation": frame_axes, "Scale": (1.0, 1.0, 1.0)}
    placed = tree.out("FunctionNodeCombineTransform", "Transform", inputs)
    placed = tree.out("FunctionNodeMatrixMultiply", "Matrix", {0: given("Transform"), 1: placed})
    inverse = tree.out("FunctionNodeInvertMatrix", "Matrix", {"Matrix": placed})

    # Lengths at rest are 1 in the frame's space and `unit` in the splat object's.
    unit = tree.vector("LENGTH", direction(tree, (1.0, 0.0, 0.0), placed))
    per_unit = tree.math("DIVIDE", 1.0, unit)
    # A joint has no point along y: the way to the middle of the segment tells at least which way round it is.
    before = tree.vector("SUBTRACT", origin, sampled(position, -4.0))
    along = choose(tree, last, away[1], before)
    x, z = (tree.scale(axes[k], per_unit) for k in (0, 2))
    y = choose(tree, joint, tree.scale(axes[1], per_unit), tree.vector("NORMALIZE", along))
    mirrored = tree.math("LESS_THAN", tree.vector("DOT_PRODUCT", tree.vector("CROSS_PRODUCT", x, y), z), 0.0)
    following = [sampled(position, 4.0 + k) for k in range(4)]
    ahead = [tree.scale(tree.vector("SUBTRACT", following[k], following[0]), inverse_size) for k in (1, 3)]
    inputs = {"X": x, "Y": y, "Z": z, "Kind": kind, "Mirrored": mirrored}
    inputs |= {f"{name} Ahead": tree.scale(axis, per_unit) for name, axis in zip("XZ", ahead, strict=True)}
    way = tree.vector("SUBTRACT", following[0], origin)
    inputs["Way"] = tree.scale(way, tree.math("DIVIDE", per_unit, span))
    stretch = tree.call(_unevenness_group(), inputs)["Stretch"]
    rigid = tree.math("SUBTRACT", 1.0, joint)
    # Joints have no y of their own, and plain bones keep what they always had.
    stretched = tree.math("GREATER_THAN", parts(tree, stretch)[0], RIGID)
    inputs = {"X": x, "Y": y, "Z": z, "X Away": away[0], "Z Away": away[2], "Axes": frame_axes, "Rest": rest}
    inputs |= {"Mirrored": mirrored, "Own": tree.math("MULTIPLY", stretched, rigid)}
    kinds = dict.fromkeys(inputs, "Vector") | dict.fromkeys(("Axes", "Rest"), "Rotation")
    kinds |= dict.fromkeys(("Mirrored", "Own"), "Float")
    group = function_group("GSkin Bone Turn", VERSION, kinds, {"Turn": "Rotation"}, _bone_turn)
    turn = tree.call(group, inputs)["Turn"]

    second = choose(tree, joint, axes[1], corners[2])
    matrix = matrix_of(tree, [axes[0], second, axes[2], origin])
    for name, data, value in (
        (names.TURN, "QUATERNION", turn),
        (names.FRAME_MAP, "FLOAT4X4", matrix),
        (names.FRAME_INVERSE, "FLOAT4X4", inverse),
        (names.FRAME_LOCAL, "FLOAT4X4", tree.out("FunctionNodeMatrixMultiply", "Matrix", {0: matrix, 1: inverse})),
        (names.FRAME_ODD, "FLOAT", tree.math("MAXIMUM", parts(tree, stretch)[1], mirrored)),
        (names.FRAME_STRETCH, "FLOAT_VECTOR", stretch),
        (names.FRAME_BEND, "FLOAT_VECTOR", bend),
    ):
        points = tree.store(points, name, data, value)
    return {"Points": points}


def _bone_turn(tree: Tree, given: Input) -> dict[str, Any]:
    """The bone's rotation in the splat object's space: of its axes as they are, or of their polar decomposition."""
    sign = tree.math("MULTIPLY_ADD", given("Mirrored"), -2.0, 1.0)
    polar = polar_rotation(tree, [tree.scale(given(axis), sign) for axis in "XYZ"])
    axes = {
        name: choose(tree, given("Own"), tree.scale(given(f"{axis} Away"), sign), own)
        for name, axis, own in (("Primary Axis", "Z", polar[2]), ("Secondary Axis", "X", polar[0]))
    }
    turn = tree.out("FunctionNodeAxesToRotation", "Rotation", axes, primary_axis="Z", secondary_axis="X")
    # The frame's axes and the way between the two objects are taken off on the right.
    for other in ("Axes", "Rest"):
        back = tree.out("FunctionNodeInvertRotation", "Rotation", {"Rotation": given(other)})
        inputs = {"Rotation": turn, "Rotate By": back}
        turn = tree.out("FunctionNodeRotateRotation", "Rotation", inputs, rotation_space="LOCAL")
    return {"Turn": turn}


def _unevenness(tree: Tree, given: Input) -> dict[str, Any]:
    """FRAME_STRETCH from axes of length 1 at rest, and of a joint the next one's and the way there in segments."""
    x, y, z = (given(axis) for axis in "XYZ")
    joint, last = tree.math("GREATER_THAN", given("Kind"), 0.5), tree.math("GREATER_THAN", given("Kind"), 1.5)
    whole = tree.math("SUBTRACT", 1.0, joint)  # a joint has no y of its own
    xx, yy, zz = (tree.vector("DOT_PRODUCT", axis, axis) for axis in (x, y, z))
    total = tree.math("ADD", tree.math("MULTIPLY_ADD", yy, whole, xx), zz)
    mean = tree.math("DIVIDE", total, tree.math("ADD", whole, 2.0))
    mixed = [tree.vector("DOT_PRODUCT", a, b) for a, b in ((x, z), (x, y), (y, z))]

    def off(factor: Any) -> Any:
        """Half the Frobenius norm of the Gram matrix times a factor, less the identity."""
        square: Any = 0.0
        for value, share in ((xx, 1.0), (zz, 1.0), (yy, whole)):
            value = tree.math("MULTIPLY_ADD", value, factor, -1.0)
            square = tree.math("MULTIPLY_ADD", tree.math("MULTIPLY", value, value), share, square)
        for value, share in zip(mixed, (2.0, *[tree.math("MULTIPLY", whole, 2.0)] * 2), strict=True):
            value = tree.math("MULTIPLY", value, factor)
            square = tree.math("MULTIPLY_ADD", tree.math("MULTIPLY", value, value), share, square)
        return tree.math("MULTIPLY", tree.math("SQRT", square), 0.5)

    way = given("Way")
    changes = [tree.vector("SUBTRACT", given(f"{name} Ahead"), axis) for name, axis in (("X", x), ("Z", z))]
    changes.append(tree.vector("CROSS_PRODUCT", way, tree.vector("CROSS_PRODUCT", z, x)))
    bent = tree.math("ABSOLUTE", tree.math("SUBTRACT", tree.vector("LENGTH", way), 1.0))
    for change in changes:
        bent = tree.math("MAXIMUM", bent, tree.vector("LENGTH", change))
    bent = tree.math("MULTIPLY", bent, tree.math("SUBTRACT", joint, last))
    own = tree.math("MAXIMUM", off(1.0), given("Mirrored"))
    even = off(tree.math("DIVIDE", 1.0, mean))
    distances = [tree.math("MAXIMUM", value, bent) for value in (own, even)]
    return {"Stretch": vector(tree, [*distances, tree.math("SQRT", mean)])}


def direction(tree: Tree, way: Any, matrix: Any) -> Any:
    """A direction under a 4 x 4 matrix."""
    inputs = {"Direction": way, "Transform": matrix}
    return tree.out("FunctionNodeTransformDirection", "Direction", inputs)


def bounds(tree: Tree, points: Any, value: Any) -> tuple[Any, Any]:
    """The smallest and the largest value of a field of floats over points, as single values."""
    inputs = {"Geometry": points, "Attribute": value}
    node = tree.node("GeometryNodeAttributeStatistic", inputs, data_type="FLOAT", domain="POINT")
    return tree.output(node, "Min"), tree.output(node, "Max")


def matrix_of(tree: Tree, columns: list[Any], last_row: list[Any] | None = None) -> Any:
    """A 4 x 4 matrix field of four vectors, its columns, and the numbers below them."""
    below = [0.0, 0.0, 0.0, 1.0] if last_row is None else last_row
    values: list[Any] = []
    for column, number in zip(columns, below, strict=True):
        values += [*parts(tree, column), number]
    return tree.out("FunctionNodeCombineMatrix", "Matrix", dict(enumerate(values)))


def choose(tree: Tree, condition: Any, no: Any, yes: Any, kind: str = "VECTOR") -> Any:
    """One of two values; of single values and geometries only the chosen one is computed."""
    inputs = {"Switch": condition, "False": no, "True": yes}
    return tree.out("GeometryNodeSwitch", "Output", inputs, input_type=kind)
