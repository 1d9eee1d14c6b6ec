# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that keeps splats on a moving proxy mesh, with rotation and shear (Eq. 4-5), without Python.

The anchor mesh (see `anchored.py`) has the proxy's triangles and the coefficients of the one-ring maps on its
corners. The group puts its vertices where the proxy's are now, sums the maps T_v (`core.rig.vertex_maps`), splits each
into rotation and shear, blends both with every splat's barycentrics, and turns T Sigma T^T back into rotation and
scales by Jacobi rotations, as `core.rig.covariance` does.
"""

from __future__ import annotations

from typing import Any

import bpy

from . import names
from .node_algebra import Columns, combine, jacobi, parts, polar_rotation, vector
from .node_builder import Tree, find_group, geometry_group

VERSION = 2
PROXY_INPUT = "Proxy Mesh"
MESH_INPUT = "Anchor Mesh"

SWEEPS = 4
FLATTEST = 1e-5
"""Thickness relative to the longest axis at which a flat splat still has a direction in 32 bits."""


def anchor_group() -> bpy.types.NodeTree:
    """The shared node group "GSkin Anchor"; built once per file."""
    nothing: dict[str, Any] = {}
    inputs = [(name, "NodeSocketObject", nothing) for name in (PROXY_INPUT, MESH_INPUT)]
    group, new = geometry_group(names.ANCHOR_MODIFIER, VERSION, inputs)
    if new:
        _build(group)
    return group


def find_anchor(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The object's anchor modifier, by its node group and not by its name."""
    return find_group(obj, names.ANCHOR_MODIFIER)


def _build(group: bpy.types.NodeTree) -> None:
    tree = Tree(group)
    source = tree.node("NodeGroupInput")
    splats = tree.output(source, "Geometry")
    proxy = _geometry(tree, tree.output(source, PROXY_INPUT), "RELATIVE")
    rest = _geometry(tree, tree.output(source, MESH_INPUT), "ORIGINAL")
    mesh = _with_maps(tree, _moved(tree, rest, proxy))
    corner = tree.math("MULTIPLY", tree.attribute(names.FACE, "INT"), 3.0)
    bary = parts(tree, tree.attribute(names.BARY, "FLOAT_VECTOR"))

    def at_corners(field: Any) -> Columns:
        return [
            tree.out(
                "GeometryNodeSampleIndex",
                "Value",
                {"Geometry": mesh, "Value": field, "Index": tree.math("ADD", corner, float(k))},
                data_type="FLOAT_VECTOR",
                domain="CORNER",
            )
            for k in range(3)
        ]

    def blended(values: Columns) -> Any:
        return combine(tree, values, bary)

    corners = at_corners(tree.out("GeometryNodeInputPosition", "Position"))
    position = tree.vector("ADD", blended(corners), _offset(tree, corners))
    rotation = [blended(at_corners(tree.attribute(name, "FLOAT_VECTOR"))) for name in names.MAP_ROTATION]
    shear = [blended(at_corners(tree.attribute(name, "FLOAT_VECTOR"))) for name in names.MAP_SHEAR]
    turned, scale = _gaussian(tree, rotation, shear)

    # All fields read the rest splats, so none may be stored before all are known.
    capture: Any = tree.node("GeometryNodeCaptureAttribute", domain="POINT")
    for kind, name in (("VECTOR", "Position"), ("ROTATION", "Rotation"), ("VECTOR", "Scale")):
        capture.capture_items.new(kind, name)
    for name, value in (("Geometry", splats), ("Position", position), ("Rotation", turned), ("Scale", scale)):
        tree.connect(value, tree.input(capture, name))
    inputs = {"Geometry": tree.output(capture, "Geometry"), "Position": tree.output(capture, "Position")}
    result = tree.out("GeometryNodeSetPosition", "Geometry", inputs)
    for name, kind, value in ((names.ROTATION, "QUATERNION", "Rotation"), (names.SCALE, "FLOAT_VECTOR", "Scale")):
        stored = {"Geometry": result, "Name": name, "Value": tree.output(capture, value)}
        result = tree.out("GeometryNodeStoreNamedAttribute", "Geometry", stored, data_type=kind, domain="POINT")

    # A proxy whose points are no longer those that were anchored to (a Subdivision Surface, an edit): stay at rest.
    counts = [
        tree.out("GeometryNodeAttributeDomainSize", "Point Count", {"Geometry": geometry}, component="MESH")
        for geometry in (proxy, rest)
    ]
    same = tree.math("COMPARE", *counts, 0.5)
    inputs = {"Switch": same, "False": splats, "True": result}
    tree.node(
        "NodeGroupOutput",
        {"Geometry": tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")},
    )
    tree.lay_out()


def _geometry(tree: Tree, obj: Any, space: str) -> Any:
    return tree.out("GeometryNodeObjectInfo", "Geometry", {"Object": obj}, transform_space=space)


def _moved(tree: Tree, rest: Any, proxy: Any) -> Any:
    """The anchor mesh with its vertices where the proxy's are, in the splat object's space."""
    position = tree.out("GeometryNodeInputPosition", "Position")
    index = tree.out("GeometryNodeInputIndex", "Index")
    inputs = {"Geometry": proxy, "Value": position, "Index": index}
    there = tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="FLOAT_VECTOR", domain="POINT")
    return tree.out("GeometryNodeSetPosition", "Geometry", {"Geometry": rest, "Position": there})


def _with_maps(tree: Tree, mesh: Any) -> Any:
    """The mesh with R_v and S_v as three vectors (columns) each on its points."""
    position = tree.out("GeometryNodeInputPosition", "Position")

    def edge(name: str) -> Any:
        inputs = {"Value": position, "Index": tree.attribute(name, "INT")}
        there = tree.out("GeometryNodeFieldAtIndex", "Value", inputs, data_type="FLOAT_VECTOR", domain="POINT")
        return tree.vector("SUBTRACT", there, position)

    to_next, to_last = edge(names.CORNER_NEXT), edge(names.CORNER_LAST)
    vertex = tree.out(
        "GeometryNodeVertexOfCorner", "Vertex Index", {"Corner Index": tree.out("GeometryNodeInputIndex", "Index")}
    )

    def at_vertex(added: Any, kind: str) -> Any:
        """What the corners of a vertex add up to."""
        node = tree.node("GeometryNodeAccumulateField", data_type=kind, domain="CORNER")
        tree.connect(added, next(s for s in node.inputs if s.name == "Value" and s.enabled))
        tree.connect(vertex, next(s for s in node.inputs if s.name.startswith("Group") and s.enabled))
        return next(s for s in node.outputs if s.name == "Total" and s.enabled)

    across = tree.vector("CROSS_PRODUCT", to_next, to_last)
    area = tree.math("MULTIPLY", tree.vector("LENGTH", across), tree.attribute(names.RING_SHARE, "FLOAT"))
    thick = tree.scale(tree.vector("NORMALIZE", across), tree.math("SQRT", at_vertex(area, "FLOAT")))
    seen = [to_next, to_last, thick]
    coefficients = [parts(tree, tree.attribute(name, "FLOAT_VECTOR")) for name in names.MAP_COEFFICIENTS]
    columns = [
        at_vertex(combine(tree, seen, [parts[k] for parts in coefficients]), "FLOAT_VECTOR") for k in range(3)
    ]
    stored = [f"gskin:t_{k}" for k in range(3)]
    mesh = _store(tree, mesh, stored, columns)
    maps = [tree.attribute(name, "FLOAT_VECTOR") for name in stored]
    mesh = _store(tree, mesh, names.MAP_ROTATION, polar_rotation(tree, maps))
    rotation = [tree.attribute(name, "FLOAT_VECTOR") for name in names.MAP_ROTATION]
    shear = [vector(tree, [tree.vector("DOT_PRODUCT", axis, column) for axis in rotation]) for column in maps]
    return _store(tree, mesh, names.MAP_SHEAR, shear)


def _store(tree: Tree, geometry: Any, labels: Any, values: Columns) -> Any:
    for name, value in zip(labels, values, strict=True):
        inputs = {"Geometry": geometry, "Name": name, "Value": value}
        geometry = tree.out(
            "GeometryNodeStoreNamedAttribute", "Geometry", inputs, data_type="FLOAT_VECTOR", domain="POINT"
        )
    return geometry


def _offset(tree: Tree, corners: Columns) -> Any:
    """What Eq. 4 adds to the foot point: offset and residual, times the posed circumradius, in the posed frame."""
    first, last = tree.vector("SUBTRACT", corners[1], corners[0]), tree.vector("SUBTRACT", corners[2], corners[0])
    across = tree.vector("CROSS_PRODUCT", first, last)
    edges = [tree.vector("LENGTH", edge) for edge in (first, last, tree.vector("SUBTRACT", last, first))]
    product = tree.math("MULTIPLY", tree.math("MULTIPLY", edges[0], edges[1]), edges[2])
    double = tree.vector("LENGTH", across)
    radius = tree.math("DIVIDE", tree.math("MULTIPLY", product, 0.5), double)
    most = tree.math("MULTIPLY", tree.attribute(names.REACH, "FLOAT"), tree.math("SQRT", double))
    radius = tree.math("MINIMUM", radius, most)
    normal, tangent = tree.vector("NORMALIZE", across), tree.vector("NORMALIZE", first)
    frame = [tangent, tree.vector("CROSS_PRODUCT", normal, tangent), normal]
    local = parts(tree, tree.attribute(names.RESIDUAL, "FLOAT_VECTOR"))
    local[2] = tree.math("ADD", local[2], tree.attribute(names.BETA, "FLOAT"))
    return tree.scale(combine(tree, frame, local), radius)


def _gaussian(tree: Tree, rotation: Columns, shear: Columns) -> tuple[Any, Any]:
    """The splat's new rotation and scale: Sigma' = T Sigma T^T, T = rotation x shear (columns)."""
    old = tree.attribute(names.ROTATION, "QUATERNION")
    sizes = parts(tree, tree.attribute(names.SCALE, "FLOAT_VECTOR"))
    longest = tree.math("MAXIMUM", tree.math("MAXIMUM", sizes[0], sizes[1]), sizes[2])
    columns = []
    for k in range(3):
        axis = [0.0, 0.0, 0.0]
        axis[k] = 1.0
        inputs = {"Vector": tuple(axis), "Rotation": old}
        direction = tree.out("FunctionNodeRotateVector", "Vector", inputs)
        relative = tree.math("MAXIMUM", tree.math("DIVIDE", sizes[k], longest), FLATTEST)
        moved = combine(tree, rotation, parts(tree, combine(tree, shear, parts(tree, direction))))
        columns.append(tree.scale(moved, relative))
    for _ in range(SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            columns[p], columns[q] = jacobi(tree, columns[p], columns[q])
    axes = {"Primary Axis": columns[0], "Secondary Axis": columns[1]}
    turned = tree.out("FunctionNodeAxesToRotation", "Rotation", axes, primary_axis="X", secondary_axis="Y")
    return turned, tree.scale(vector(tree, [tree.vector("LENGTH", column) for column in columns]), longest)
