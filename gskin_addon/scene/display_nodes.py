# SPDX-License-Identifier: GPL-3.0-or-later
"""The nodes of the display: Blender's own splats, instances for renders, octahedra or bare points for the viewport.

What they are made of are node groups of their own: Blender looks at a whole tree after each node, link and value, so
one tree of five hundred nodes takes a second to build, and many small ones a tenth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from . import names
from .display_colors import (
    SHOW_BONES,
    SHOW_CONFIDENCE,
    SHOW_WEIGHTS_OF,
    by_bones_group,
    linear_group,
    shown_group,
    splat_color,
)
from .display_inputs import BY_SHADER, DISPLAY, FACING, LIMIT, MINIMUM_OPACITY, NATIVE, OCTAHEDRA, SIZE
from .harmonics_nodes import harmonics_parts
from .native_nodes import has_native_splats, native_group, native_parts
from .node_builder import Input, Tree, function_group
from .octahedra import CORNERS, ensure_octahedra
from .sampled import Sampled
from .seen_color import seen_parts
from .soft_nodes import soft_group
from .viewport.nodes import shader_points_group

VERSION = 1
"""Of the node groups inside."""

VIEWPORT_SIGMAS = 1.6
"""Radius of a splat drawn solid. A Gaussian stops to hide what is behind it at about 1.2 standard deviations; an
octahedron needs more to cover as much, and with less a surface shows holes."""


def display_parts() -> tuple[Callable[[], object], ...]:
    """What builds the groups that `build_display` uses, each after those that it uses itself."""
    parts = (
        linear_group, by_bones_group, shown_group, *seen_parts(), soft_group, shader_points_group,
        octahedra_group,
    )  # fmt: skip
    return (*parts, *harmonics_parts(), *native_parts(), native_group) if has_native_splats() else parts


def build_display(group: bpy.types.NodeTree) -> None:
    """Fill the empty display group."""
    tree = Tree(group)
    source = tree.node("NodeGroupInput")
    splats = tree.output(source, "Geometry")
    size = tree.output(source, SIZE)
    in_viewport = tree.out("GeometryNodeIsViewport", "Is Viewport")

    count = tree.domain_size(splats, "MESH")
    limited = tree.math("MINIMUM", count, tree.output(source, LIMIT))
    inputs = {"Switch": in_viewport, "False": count, "True": limited}
    shown = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="INT")
    step = tree.math("DIVIDE", count, shown)
    index = tree.out("GeometryNodeInputIndex", "Index")
    sampled = Sampled(tree, splats, tree.math("FLOOR", tree.math("MULTIPLY", index, step)))

    base = sampled(names.BASE, "FLOAT_COLOR")
    opacity = tree.output(tree.node("FunctionNodeSeparateColor", {"Color": base}), "Alpha")
    shown_as = {label: tree.output(source, label) for label in (SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF)}
    color = splat_color(tree, sampled, shown_as, seen=True)
    points = tree.out("GeometryNodePoints", "Points", {"Count": shown, "Position": sampled("position", "FLOAT_VECTOR")})
    points = tree.store(points, names.COLOR, "FLOAT_COLOR", color)
    placed = tree.store(points, names.ROTATION, "QUATERNION", sampled(names.ROTATION, "QUATERNION"))
    placed = tree.store(placed, names.SCALE, "FLOAT_VECTOR", sampled(names.SCALE, "FLOAT_VECTOR"))

    # Fewer splats are drawn larger, so that the surface stays closed.
    wider = tree.math("MULTIPLY", tree.math("SQRT", tree.math("MINIMUM", step, 9.0)), VIEWPORT_SIGMAS)
    wider = tree.math("MULTIPLY", size, wider)
    faint = tree.math("LESS_THAN", opacity, tree.output(source, MINIMUM_OPACITY))
    inputs = {"Points": placed, "Faint": faint, "Size": wider, "Octahedra": tree.output(source, OCTAHEDRA)}
    solid = tree.call(octahedra_group(), inputs)["Geometry"]

    inputs = {"Points": placed, "Opacity": opacity, "Size": size, "Facing": tree.output(source, FACING)}
    soft = tree.call(soft_group(), inputs)["Instances"]

    bare = tree.call(shader_points_group(), {"Splats": splats, **shown_as})["Points"]
    inputs = {"Switch": tree.output(source, BY_SHADER), "False": solid, "True": bare}
    solid = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    inputs = {"Switch": in_viewport, "False": soft, "True": solid}
    drawn = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    if has_native_splats():
        native = tree.call(native_group(), {"Splats": splats, "Size": size, **shown_as})["Points"]
        # In Solid mode of a window the shader draws them: with few samples Blender's own are grainy there.
        by_shader = tree.math("MULTIPLY", in_viewport, tree.output(source, BY_SHADER))
        shown_native = tree.math("GREATER_THAN", tree.output(source, NATIVE), by_shader)
        inputs = {"Switch": shown_native, "False": drawn, "True": native}
        drawn = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    # Without a display nothing is seen of the fabric either, see `fabric.py`.
    inputs = {"Geometry": splats}
    bare = tree.out("GeometryNodeDeleteGeometry", "Geometry", inputs, domain="EDGE", mode="EDGE_FACE")
    inputs = {"Switch": tree.output(source, DISPLAY), "False": bare, "True": drawn}
    result = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    tree.node("NodeGroupOutput", {"Geometry": result})
    tree.lay_out()


def octahedra_group() -> bpy.types.NodeTree:
    """The node group that makes one octahedron of each point that is not `Faint`.

    Octahedra: the helper whose faces are borrowed; where it has another number than there are points, as after a
    change of the settings, faces are made the slow way.
    """
    kinds = {"Points": "Geometry", "Faint": "Float", "Size": "Float", "Octahedra": "Object"}
    return function_group("GSkin Octahedra", VERSION, kinds, {"Geometry": "Geometry"}, _octahedra)


def _octahedra(tree: Tree, given: Input) -> dict[str, Any]:
    points, faint, size = given("Points"), given("Faint"), given("Size")
    inputs = {"Geometry": points, "Selection": faint}
    seen = tree.out("GeometryNodeDeleteGeometry", "Geometry", inputs, domain="POINT")
    borrowed = tree.object_geometry(given("Octahedra"))
    corners = tree.math("MULTIPLY", tree.domain_size(seen, "POINTCLOUD"), float(CORNERS))
    operands = {0: corners, 1: tree.domain_size(borrowed, "MESH"), 2: 0.5}
    fits = tree.out("ShaderNodeMath", "Value", operands, operation="COMPARE")
    inputs = {
        "Points": points,
        "Instance": tree.object_geometry(ensure_octahedra(1)),
        "Selection": tree.math("SUBTRACT", 1.0, faint),
        "Rotation": tree.attribute(names.ROTATION, "QUATERNION"),
        "Scale": tree.scale(tree.attribute(names.SCALE, "FLOAT_VECTOR"), size),
    }
    made = tree.out("GeometryNodeInstanceOnPoints", "Instances", inputs)
    made = tree.out("GeometryNodeRealizeInstances", "Geometry", {"Geometry": made})
    inputs = {"Switch": fits, "False": made, "True": _place(tree, borrowed, seen, size)}
    return {"Geometry": tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")}


def _place(tree: Tree, octahedra: Any, points: Any, factor: Any) -> Any:
    """Octahedron i moved, turned, sized and coloured as point i says."""
    index = tree.out("GeometryNodeInputIndex", "Index")
    # Indices are whole, so that the half keeps rounding away from the next octahedron.
    point = tree.math("FLOOR", tree.math("DIVIDE", tree.math("ADD", index, 0.5), float(CORNERS)))
    at_corner = Sampled(tree, points, point)
    corner = tree.scale(tree.out("GeometryNodeInputPosition", "Position"), factor)
    corner = tree.vector("MULTIPLY", corner, at_corner(names.SCALE, "FLOAT_VECTOR"))
    inputs = {"Vector": corner, "Rotation": at_corner(names.ROTATION, "QUATERNION")}
    corner = tree.out("FunctionNodeRotateVector", "Vector", inputs)
    corner = tree.vector("ADD", corner, at_corner("position", "FLOAT_VECTOR"))
    placed = tree.out("GeometryNodeSetPosition", "Geometry", {"Geometry": octahedra, "Position": corner})
    return tree.store(placed, names.COLOR, "FLOAT_COLOR", at_corner(names.COLOR, "FLOAT_COLOR"))
