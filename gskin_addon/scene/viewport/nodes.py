# SPDX-License-Identifier: GPL-3.0-or-later
"""What the display's nodes give while the shader draws the splats: their bare points, which Blender shows nothing of.

A mesh without edges and faces is drawn as dark dots that hide what is behind them; one edge without length stops
that. The points carry what the shader needs and nothing else, since joining copies every attribute.
"""

from __future__ import annotations

from typing import Any

import bpy

from .. import names
from ..display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF, splat_color
from ..node_builder import Input, Tree, function_group
from ..sampled import Sampled

VERSION = 1
"""Of the node group."""

EXTRA_POINTS = 2
"""The ends of the edge; they come after the splats."""


def shader_points_group() -> bpy.types.NodeTree:
    """The node group that makes the points of the mesh `Splats`, with one edge.

    Show Bones, Show Confidence, Show Weights Of: single values; where one is set, the points have names.COLOR too.
    """
    kinds = {"Splats": "Geometry", SHOW_BONES: "Bool", SHOW_CONFIDENCE: "Bool", SHOW_WEIGHTS_OF: "String"}
    return function_group("GSkin Shader Points", VERSION, kinds, {"Points": "Geometry"}, _shader_points)


def _shader_points(tree: Tree, given: Input) -> dict[str, Any]:
    splats = given("Splats")
    sampled = Sampled(tree, splats, tree.out("GeometryNodeInputIndex", "Index"))
    shown_as = {label: given(label) for label in (SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF)}
    count = tree.domain_size(splats, "MESH")
    points = tree.out("GeometryNodePoints", "Points", {"Count": count, "Position": sampled("position", "FLOAT_VECTOR")})
    for name, kind in ((names.ROTATION, "QUATERNION"), (names.SCALE, "FLOAT_VECTOR"), (names.BASE, "FLOAT_COLOR")):
        points = tree.store(points, name, kind, sampled(name, kind))
    turned = tree.store(points, names.TURN, "QUATERNION", sampled(names.TURN, "QUATERNION"))
    points = _switch(tree, sampled.has(names.TURN, "QUATERNION"), points, turned)
    special = tree.store(points, names.COLOR, "FLOAT_COLOR", splat_color(tree, sampled, shown_as))
    show_bones, show_confidence, show_weights_of = shown_as.values()
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
    return {"Points": tree.output(join, "Geometry")}


def _switch(tree: Tree, switch: Any, false: Any, true: Any) -> Any:
    inputs = {"Switch": switch, "False": false, "True": true}
    return tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
