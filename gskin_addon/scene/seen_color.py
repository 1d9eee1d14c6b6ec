# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of splats as the scene's camera sees them, as nodes: their harmonics along the way from it, degree 1 to 3."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..core.splats.cloud import SH_C0
from ..core.splats.sh import basis_constants
from . import names
from .node_builder import Tree

MAX_DEGREE = 3

Sampled = Callable[[Any, str], Any]


def towards_camera(tree: Tree, position: Any) -> tuple[Any, Any]:
    """Field of the way (not normalised) from points to the scene's active camera, both in the object's space.

    And whether there is a camera, a single boolean. The way leads to the camera's place in orthographic views too:
    nodes are not told of which kind it is.
    """
    camera = tree.out("GeometryNodeInputActiveCamera", "Active Camera")
    info = tree.node("GeometryNodeObjectInfo", {"Object": camera}, transform_space="RELATIVE")
    # Of no object the node gives zeros.
    there = tree.math("GREATER_THAN", tree.vector("LENGTH", tree.output(info, "Scale")), 0.0)
    return tree.vector("SUBTRACT", tree.output(info, "Location"), position), there


def seen_color(tree: Tree, splats: Any, sampled: Sampled, base: Any) -> Any:
    """Field of sRGB colour, 0 to 1, of the drawn points: max(0, 0.5 + sum_k sh_k Y_k(d)), as `core.splats.sh.eval_sh`.

    splats: the geometry that has the attributes; how many bands it has decides what is computed at all. base: the
    first coefficients, which count alone where there is no camera. The direction is turned back by what the bones
    have turned each splat (`gskin:turn`).
    """
    total = tree.vector("MULTIPLY_ADD", base, (SH_C0,) * 3, (0.5,) * 3)
    towards, has_camera = towards_camera(tree, sampled("position", "FLOAT_VECTOR"))
    away = tree.scale(towards, -1.0)
    back = tree.out("FunctionNodeInvertRotation", "Rotation", {"Rotation": sampled(names.TURN, "QUATERNION")})
    turned = tree.out("FunctionNodeRotateVector", "Vector", {"Vector": away, "Rotation": back})
    inputs = {"Switch": tree.has(splats, names.TURN, "QUATERNION"), "False": away, "True": turned}
    direction = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    values = _basis(tree, tree.vector("NORMALIZE", direction))
    constant = shown = total
    for degree in range(1, MAX_DEGREE + 1):
        for k in range(degree * degree, (degree + 1) ** 2):
            coefficient = sampled(names.SH.format(k - 1), "FLOAT_VECTOR")
            total = tree.vector("ADD", total, tree.scale(coefficient, values[k]))
        there = tree.has(splats, names.SH.format(degree * degree - 1), "FLOAT_VECTOR")
        inputs = {"Switch": there, "False": shown, "True": total}
        shown = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    inputs = {"Switch": has_camera, "False": constant, "True": shown}
    shown = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    return tree.vector("MINIMUM", tree.vector("MAXIMUM", shown, (0.0,) * 3), (1.0,) * 3)


def _basis(tree: Tree, direction: Any) -> list[Any]:
    """Fields of the 16 basis functions at a unit direction; the first is a constant."""
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": direction})
    x, y, z = (tree.output(parts, axis) for axis in "XYZ")

    def times(*factors: Any) -> Any:
        product = factors[0]
        for factor in factors[1:]:
            product = tree.math("MULTIPLY", product, factor)
        return product

    def total(a: Any, b: Any, *, of_a: float = 1.0, of_b: float = 1.0) -> Any:
        return tree.math("MULTIPLY_ADD", a, of_a, tree.math("MULTIPLY", b, of_b))

    xx, yy, zz, xy, yz, xz = times(x, x), times(y, y), times(z, z), times(x, y), times(y, z), times(x, z)
    both = total(xx, yy)
    less = total(xx, yy, of_b=-1.0)
    bands = [
        y, z, x,
        xy, yz, total(zz, both, of_a=2.0, of_b=-1.0), xz, less,
        times(y, total(xx, yy, of_a=3.0, of_b=-1.0)), times(xy, z), times(y, total(zz, both, of_a=4.0, of_b=-1.0)),
        times(z, total(zz, both, of_a=2.0, of_b=-3.0)), times(x, total(zz, both, of_a=4.0, of_b=-1.0)),
        times(z, less), times(x, total(xx, yy, of_b=-3.0)),
    ]  # fmt: skip
    return [SH_C0, *(times(value, c) for value, c in zip(bands, basis_constants(), strict=True))]
