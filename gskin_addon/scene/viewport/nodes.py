# SPDX-License-Identifier: GPL-3.0-or-later
"""What the display's nodes give while the shader draws the splats: their bare points, which Blender shows nothing of.

A mesh without edges and faces is drawn as dark dots that hide what is behind them; one edge without length stops
that. The points carry what the shader needs and nothing else, since joining copies every attribute.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from .. import names
from ..node_builder import Tree

EXTRA_POINTS = 2
"""The ends of the edge; they come after the splats."""


def shader_points(tree: Tree, splats: Any, shown_as: Sequence[Any], color: Callable[..., Any]) -> Any:
    """The points of the mesh `splats` with one edge, as a geometry.

    shown_as: show bones, show confidence, show the weights of; where one is set, the points have names.COLOR too.
    color: `display_colors.splat_color` with the tree.
    """
    index = tree.out("GeometryNodeInputIndex", "Index")

    def sampled(name: Any, kind: str) -> Any:
        inputs = {"Geometry": splats, "Value": tree.attribute(name, kind), "Index": index}
        return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    count = tree.domain_size(splats, "MESH")
    points = tree.out("GeometryNodePoints", "Points", {"Count": count, "Position": sampled("position", "FLOAT_VECTOR")})
    for name, kind in ((names.ROTATION, "QUATERNION"), (names.SCALE, "FLOAT_VECTOR"), (names.BASE, "FLOAT_COLOR")):
        points = tree.store(points, name, kind, sampled(name, kind))
    turned = tree.store(points, names.TURN, "QUATERNION", sampled(names.TURN, "QUATERNION"))
    exists = tree.out("GeometryNodeInputNamedAttribute", "Exists", {"Name": names.TURN}, data_type="QUATERNION")
    inputs = {"Geometry": splats, "Value": exists, "Index": 0}
    exists = tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="BOOLEAN", domain="POINT")
    points = _switch(tree, exists, points, turned)
    special = tree.store(points, names.COLOR, "FLOAT_COLOR", color(sampled, *shown_as))
    show_bones, show_confidence, show_weights_of = shown_as
    inputs = {"A": show_weights_of, "B": ""}
    named = tree.out("FunctionNodeCompare", "Result", inputs, data_type="STRING", operation="NOT_EQUAL")
    either = tree.out("FunctionNodeBooleanMath", "Boolean", {0: show_bones, 1: show_confidence}, operation="OR")
    either = tree.out("FunctionNodeBooleanMath", "Boolean", {0: either, 1: named}, operation="OR")
    points = _switch(tree, either, points, special)
    vertices = tree.out("GeometryNodePointsToVertices", "Mesh", {"Points": points})
    first = tree.out("GeometryNodeInputPosition", "Position")
    inputs = {"Geometry": splats, "Value": first, "Index": 0}
    first = tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="FLOAT_VECTOR", domain="POINT")
    inputs = {"Count": EXTRA_POINTS, "Start Location": first, "Offset": (0.0, 0.0, 0.0)}
    edge = tree.out("GeometryNodeMeshLine", "Mesh", inputs, mode="OFFSET")
    join = tree.node("GeometryNodeJoinGeometry")
    for part in (edge, vertices):  # the one that is linked last comes first
        tree.connect(part, join.inputs["Geometry"])
    return tree.output(join, "Geometry")


def _switch(tree: Tree, switch: Any, false: Any, true: Any) -> Any:
    inputs = {"Switch": switch, "False": false, "True": true}
    return tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
