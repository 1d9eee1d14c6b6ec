# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats as renders draw them without native splats, as nodes: instances whose material fades like the Gaussian.

A ray meets a splat where it enters the instance's surface, and blends what it meets in that order. With ellipsoids
the order is wrong: a long splat beneath the skin sticks out of it and is blended first, which tears faces. So each
splat is a flat disc through its centre, which lies where rays from the scene's camera find the Gaussian densest: order
and depth are then those of the splat's centre, as in true splatting, and every splat costs one hit in place of two.
"""

from __future__ import annotations

import math
from typing import Any

import bpy

from . import names
from .materials import FAINTEST, render_material
from .node_builder import Input, Tree, function_group
from .seen_color import towards_camera

VERSION = 1
"""Of the node group."""
SIDES = 8
"""Corners of a disc; it encloses the circle."""

THINNEST = 1e-4
"""Thickness, relative to the longest axis, at which a flat splat still has a facing."""


def soft_group() -> bpy.types.NodeTree:
    """The node group that makes instances of points that have `rotation` and `scale`.

    Opacity: field over the points. Size: factor. Facing: a single boolean, discs towards the camera or whole
    ellipsoids.
    """
    kinds = {"Points": "Geometry", "Opacity": "Float", "Size": "Float", "Facing": "Bool"}
    return function_group("GSkin Soft Splats", VERSION, kinds, {"Instances": "Geometry"}, _soft_splats)


def _soft_splats(tree: Tree, given: Input) -> dict[str, Any]:
    points, opacity, size, facing = (given(label) for label in ("Points", "Opacity", "Size", "Facing"))
    # The radius, in standard deviations, that `render_material` takes the instance to have.
    ratio = tree.math("MAXIMUM", tree.math("MULTIPLY", opacity, 1 / FAINTEST), 1.0)
    reach = tree.math("SQRT", tree.math("MULTIPLY", tree.math("LOGARITHM", ratio, math.e), 2.0))
    rotation, scale = tree.attribute(names.ROTATION, "QUATERNION"), tree.attribute(names.SCALE, "FLOAT_VECTOR")
    sphere = tree.out("GeometryNodeMeshIcoSphere", "Mesh", {"Radius": 1.0, "Subdivisions": 2})
    inputs = {"Vertices": SIDES, "Radius": 1.0 / math.cos(math.pi / SIDES)}
    disc = tree.out("GeometryNodeMeshCircle", "Mesh", inputs, fill_type="NGON")
    inputs = {"Switch": facing, "False": sphere, "True": disc}
    shape = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    shape = tree.out("GeometryNodeSetMaterial", "Geometry", {"Geometry": shape, "Material": render_material()})
    inputs = {"Points": points, "Instance": shape, "Selection": tree.math("GREATER_THAN", reach, 0.0)}
    inputs["Scale"] = tree.scale(scale, tree.math("MULTIPLY", size, reach))
    inputs["Rotation"] = rotation
    instances = tree.out("GeometryNodeInstanceOnPoints", "Instances", inputs)
    facing_camera = _faced(tree, instances, rotation, scale)
    inputs = {"Switch": facing, "False": instances, "True": facing_camera}
    return {"Instances": tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")}


def _faced(tree: Tree, instances: Any, rotation: Any, scale: Any) -> Any:
    """The instances with their discs turned, within the ellipsoid's own unit sphere, to face the camera."""
    way, _ = towards_camera(tree, tree.out("GeometryNodeInputPosition", "Position"))
    back = tree.out("FunctionNodeInvertRotation", "Rotation", {"Rotation": rotation})
    local = tree.out("FunctionNodeRotateVector", "Vector", {"Vector": way, "Rotation": back})
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": scale})
    longest = tree.math("MAXIMUM", tree.math("MAXIMUM", *(tree.output(parts, axis) for axis in "XY")),
                        tree.output(parts, "Z"))  # fmt: skip
    least = tree.math("MAXIMUM", tree.math("MULTIPLY", longest, THINNEST), 1e-12)
    thick = tree.out("ShaderNodeCombineXYZ", "Vector", dict.fromkeys("XYZ", least))
    normal = tree.vector("NORMALIZE", tree.vector("DIVIDE", local, tree.vector("MAXIMUM", scale, thick)))
    turn = tree.out("FunctionNodeAlignRotationToVector", "Rotation", {"Vector": normal}, axis="Z")
    own = tree.out("FunctionNodeCombineTransform", "Transform", {"Rotation": turn})
    present = tree.out("GeometryNodeInstanceTransform", "Transform")
    matrix = tree.out("FunctionNodeMatrixMultiply", "Matrix", {0: present, 1: own})
    inputs = {"Instances": instances, "Transform": matrix}
    return tree.out("GeometryNodeSetInstanceTransform", "Instances", inputs)
