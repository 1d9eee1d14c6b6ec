# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of splats as the scene's camera sees them, as nodes: their harmonics along the way from it, degree 1 to 3."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import bpy

from ..core.splats.cloud import SH_C0
from ..core.splats.sh import basis_constants
from . import names
from .node_builder import Input, Tree, function_group
from .sampled import Sampled

VERSION = 1
"""Of the node groups inside."""
MAX_DEGREE = 3


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


def seen_color(tree: Tree, sampled: Sampled) -> Any:
    """Field of sRGB colour, 0 to 1, of the drawn points: max(0, 0.5 + sum_k sh_k Y_k(d)), as `core.splats.sh.eval_sh`.

    How many bands the splats have decides what is computed at all; without a camera the constant one counts alone.
    The direction is turned back by what the bones have turned each splat (`gskin:turn`).
    """
    return tree.call(seen_group(), sampled.given)["Color"]


def seen_group() -> bpy.types.NodeTree:
    """The node group of `seen_color`."""
    return function_group("GSkin Seen Color", VERSION, Sampled.SOCKETS, {"Color": "Vector"}, _seen)


def seen_parts() -> tuple[Callable[[], object], ...]:
    """What builds `seen_group`, after the groups that it uses."""
    return (basis_group, *(partial(band_group, degree) for degree in range(1, MAX_DEGREE + 1)), seen_group)


def basis_group() -> bpy.types.NodeTree:
    """The node group of the basis functions 1 to 15 at a unit direction."""
    values = {f"Y {k}": "Float" for k in range(1, (MAX_DEGREE + 1) ** 2)}
    return function_group("GSkin Harmonics", VERSION, {"Direction": "Vector"}, values, _basis)


def band_group(degree: int) -> bpy.types.NodeTree:
    """The node group that sums one band: its coefficients times the basis functions."""
    kinds = {**Sampled.SOCKETS, **dict.fromkeys(_labels(degree), "Float")}
    build = partial(_band, degree=degree)
    return function_group(f"GSkin Seen Band {degree}", VERSION, kinds, {"Color": "Vector"}, build)


def _labels(degree: int) -> list[str]:
    return [f"Y {k}" for k in range(degree * degree, (degree + 1) ** 2)]


def _band(tree: Tree, given: Input, *, degree: int) -> dict[str, Any]:
    sampled = Sampled.within(tree, given)
    total: Any = (0.0, 0.0, 0.0)
    for k, label in enumerate(_labels(degree), degree * degree):
        total = tree.vector("ADD", total, tree.scale(sampled(names.SH.format(k - 1), "FLOAT_VECTOR"), given(label)))
    return {"Color": total}


def _seen(tree: Tree, given: Input) -> dict[str, Any]:
    sampled = Sampled.within(tree, given)
    total = tree.vector("MULTIPLY_ADD", sampled(names.BASE, "FLOAT_COLOR"), (SH_C0,) * 3, (0.5,) * 3)
    towards, has_camera = towards_camera(tree, sampled("position", "FLOAT_VECTOR"))
    away = tree.scale(towards, -1.0)
    back = tree.out("FunctionNodeInvertRotation", "Rotation", {"Rotation": sampled(names.TURN, "QUATERNION")})
    turned = tree.out("FunctionNodeRotateVector", "Vector", {"Vector": away, "Rotation": back})
    inputs = {"Switch": sampled.has(names.TURN, "QUATERNION"), "False": away, "True": turned}
    direction = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    values = tree.call(basis_group(), {"Direction": tree.vector("NORMALIZE", direction)})
    constant = shown = total
    for degree in range(1, MAX_DEGREE + 1):
        inputs = {**sampled.given, **{label: values[label] for label in _labels(degree)}}
        total = tree.vector("ADD", total, tree.call(band_group(degree), inputs)["Color"])
        there = sampled.has(names.SH.format(degree * degree - 1), "FLOAT_VECTOR")
        inputs = {"Switch": there, "False": shown, "True": total}
        shown = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    inputs = {"Switch": has_camera, "False": constant, "True": shown}
    shown = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    return {"Color": tree.vector("MINIMUM", tree.vector("MAXIMUM", shown, (0.0,) * 3), (1.0,) * 3)}


def _basis(tree: Tree, given: Input) -> dict[str, Any]:
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": given("Direction")})
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
    scaled = (times(value, constant) for value, constant in zip(bands, basis_constants(), strict=True))
    return {f"Y {k}": value for k, value in enumerate(scaled, 1)}
