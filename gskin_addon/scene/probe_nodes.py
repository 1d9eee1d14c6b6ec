# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes that turn and stretch splats as four probes say that the space around each is moved (`probes.py`).

A splat's probes are displaced by h (1, 1, 1), h (1, -1, -1), h (-1, 1, -1) and h (-1, -1, 1), the corners of a
tetrahedron, and are put by the modifiers at p_0 to p_3. The columns of the local map are then
(p_0 + p_1 - p_2 - p_3) / 4h, (p_0 - p_1 + p_2 - p_3) / 4h and (p_0 - p_1 - p_2 + p_3) / 4h: exact for linear maps, and
without the error that forward differences have where the map bends along an axis.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from . import names
from .frame_nodes import choose, matrix_of
from .node_algebra import Columns, polar_rotation, vector
from .node_builder import Input, Tree, function_group
from .stretch_nodes import shaped_splats

VERSION = 1
"""Of the node groups."""

CORNERS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
"""Where the probes are, in steps."""
PROBES = tuple(f"Probe {k}" for k in range(len(CORNERS)))
STEP = "Probe Step"

PLAIN = 5e-4
"""How far a measured map may be from a rotation (half the norm of A^T A - I) and still count as one: differences of
32-bit coordinates leave some 1e-4. A rotation read off it is right to 0.03 degrees."""
NOTHING = 1e-6
"""Sum of the squared lengths of a map's columns below which it maps everything to one point: such a splat stays."""

_SHOT = {**dict.fromkeys(PROBES, "Geometry"), STEP: "Float"}
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_MATRIX = "FLOAT4X4"


def probed_parts() -> tuple[Callable[[], object], ...]:
    """What builds the groups of `probed_splats`."""
    return _map_group, _turned_group, _polar_group


def same_number(tree: Tree, splats: Any, probes: dict[str, Any]) -> Any:
    """Whether there is each of a splat's probes, as a single boolean; not so while splats are added and deleted."""
    count = tree.domain_size(splats, "MESH")
    wrong: Any = 0.0
    for label in PROBES:
        other = tree.domain_size(probes[label], "MESH")
        wrong = tree.math("ADD", wrong, tree.math("ABSOLUTE", tree.math("SUBTRACT", other, count)))
    return tree.math("LESS_THAN", wrong, 0.5)


def probed_splats(tree: Tree, splats: Any, probes: dict[str, Any], step: Any) -> Any:
    """The geometry with ROTATION, SCALE and TURN by the maps that the probes measure.

    probes: the evaluated probes' geometries, in the splat object's space, by `PROBES`.
    """
    found = tree.call(_map_group(), {**probes, STEP: step})["Map"]
    # Stored before it is used: as a field it would be computed for each use.
    splats = tree.store(splats, names.FRAME_MAP, _MATRIX, found)
    splats = tree.call(_turned_group(), {"Geometry": splats})["Geometry"]
    splats = tree.call(_polar_group(), {"Geometry": splats})["Geometry"]
    return tree.out("GeometryNodeRemoveAttribute", "Geometry", {"Geometry": splats, "Name": names.FRAME_MAP})


def _map_group() -> bpy.types.NodeTree:
    return function_group("GSkin Probed Map", VERSION, _SHOT, {"Map": "Matrix"}, _map)


def _turned_group() -> bpy.types.NodeTree:
    kinds = {"Geometry": "Geometry"}
    return function_group("GSkin Probed Turn", VERSION, kinds, kinds, _turn)


def _polar_group() -> bpy.types.NodeTree:
    kinds = {"Geometry": "Geometry"}
    return function_group("GSkin Probed Shape", VERSION, kinds, kinds, _shape)


def _map(tree: Tree, given: Input) -> dict[str, Any]:
    """The local map of the splat."""
    position, index = tree.out("GeometryNodeInputPosition", "Position"), tree.out("GeometryNodeInputIndex", "Index")
    places = []
    for label in PROBES:
        inputs = {"Geometry": given(label), "Value": position, "Index": index}
        node = tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="FLOAT_VECTOR", domain="POINT")
        places.append(node)
    p0, p1, p2, p3 = places
    # Differences first: sums of coordinates would lose digits.
    ways = (tree.vector("SUBTRACT", p0, p3), tree.vector("SUBTRACT", p1, p2))
    across = (tree.vector("SUBTRACT", p0, p1), tree.vector("SUBTRACT", p2, p3))
    sums = (
        tree.vector("ADD", *ways),
        tree.vector("SUBTRACT", *ways),
        tree.vector("SUBTRACT", *across),
    )
    factor = tree.math("DIVIDE", 0.25, given(STEP))
    columns = [tree.scale(total, factor) for total in sums]
    dots = [tree.vector("DOT_PRODUCT", a, a) for a in columns]
    total = tree.math("ADD", tree.math("ADD", dots[0], dots[1]), dots[2])
    some = tree.math("GREATER_THAN", total, NOTHING)
    columns = [choose(tree, some, axis, column) for axis, column in zip(_AXES, columns, strict=True)]
    return {"Map": matrix_of(tree, [*columns, (0.0, 0.0, 0.0)])}


def _stored_map(tree: Tree) -> Columns:
    node = tree.node("FunctionNodeSeparateMatrix", {"Matrix": tree.attribute(names.FRAME_MAP, _MATRIX)})
    return [vector(tree, [node.outputs[4 * k + row] for row in range(3)]) for k in range(3)]


def _turn(tree: Tree, given: Input) -> dict[str, Any]:
    """TURN where the map is a rotation, and near where it is not."""
    x, _, z = _stored_map(tree)
    turn = _rotation(tree, x, z)
    return {"Geometry": tree.store(given("Geometry"), names.TURN, "QUATERNION", turn)}


def _shape(tree: Tree, given: Input) -> dict[str, Any]:
    """ROTATION everywhere; TURN, ROTATION and SCALE by the map's polar decomposition where it is no rotation."""
    columns = _stored_map(tree)
    x, y, z = columns
    volume = tree.vector("DOT_PRODUCT", x, tree.vector("CROSS_PRODUCT", y, z))
    off: Any = tree.math("GREATER_THAN", 0.0, volume)
    for a, b in ((x, x), (y, y), (z, z)):
        error = tree.math("SUBTRACT", tree.vector("DOT_PRODUCT", a, b), 1.0)
        off = tree.math("MULTIPLY_ADD", error, error, off)
    for a, b in ((x, y), (x, z), (y, z)):
        error = tree.vector("DOT_PRODUCT", a, b)
        off = tree.math("MULTIPLY_ADD", error, tree.math("MULTIPLY", error, 2.0), off)
    selected = tree.math("GREATER_THAN", off, 4 * PLAIN**2)
    sign = tree.math("MULTIPLY_ADD", tree.math("LESS_THAN", volume, 0.0), -2.0, 1.0)
    polar = polar_rotation(tree, [tree.scale(column, sign) for column in columns])
    inputs = {"Geometry": given("Geometry"), "Selection": selected, "Name": names.TURN}
    inputs["Value"] = _rotation(tree, polar[0], polar[2])
    splats = tree.out("GeometryNodeStoreNamedAttribute", "Geometry", inputs, data_type="QUATERNION", domain="POINT")
    return {"Geometry": shaped_splats(tree, splats, columns, selected)}


def _rotation(tree: Tree, x: Any, z: Any) -> Any:
    inputs = {"Primary Axis": z, "Secondary Axis": x}
    return tree.out("FunctionNodeAxesToRotation", "Rotation", inputs, primary_axis="Z", secondary_axis="X")
