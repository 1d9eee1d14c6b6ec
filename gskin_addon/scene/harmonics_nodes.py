# SPDX-License-Identifier: GPL-3.0-or-later
"""Spherical harmonics of degree 1 to 3 turned by one quaternion per splat, as nodes.

A rotation about z mixes only the coefficients m and -m of a band, and every rotation is Rz(a) Ry(b) Rz(g) with
Ry(b) = K Rz(b) K^T, K the quarter turn about x that takes z to y. So a band is turned by Z(a) K Z(b) K^T Z(g) with
constant, sparse K: far fewer nodes than dense matrices, and none has to be stored.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.splats.sh import sh_rotation
from .node_builder import Input, Tree, function_group

VERSION = 1
"""Of the node groups."""
MAX_DEGREE = 3

_QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""K: z to y."""

Band = list[Any]
"""Fields of the 2 l + 1 coefficients of a band, rgb each."""


_ANGLES = ("Last", "Middle", "First")
"""a, b, g."""


def turned_bands(tree: Tree, bands: list[Band], turn: Any) -> list[Band]:
    """The bands l = 1, 2, 3 of coefficient fields, turned by the rotation field `turn`: f'(d) = f(turn^-1 d).

    The same as `core.splats.sh.rotate_sh`, in 32 bits.
    """
    angles = tree.call(angles_group(), {"Turn": turn})
    turned = []
    for degree, band in enumerate(bands, 1):
        inputs = {label: angles[label] for label in _angle_labels(degree)}
        inputs |= {f"C {k}": value for k, value in enumerate(band)}
        turned.append(list(tree.call(band_group(degree), inputs).values()))
    return turned


def harmonics_parts() -> tuple[Callable[[], object], ...]:
    """What builds the groups that `turned_bands` uses."""
    return (angles_group, *(partial(band_group, degree) for degree in range(1, MAX_DEGREE + 1)))


def angles_group() -> bpy.types.NodeTree:
    """The node group that gives cosine and sine of multiples of the three angles of a turn."""
    values = dict.fromkeys(_angle_labels(MAX_DEGREE), "Vector")
    return function_group("GSkin Turn Angles", VERSION, {"Turn": "Rotation"}, values, _angles)


def band_group(degree: int) -> bpy.types.NodeTree:
    """The node group that turns one band."""
    coefficients = dict.fromkeys((f"C {k}" for k in range(2 * degree + 1)), "Vector")
    kinds = {**dict.fromkeys(_angle_labels(degree), "Vector"), **coefficients}
    build = partial(_band, degree=degree)
    return function_group(f"GSkin Turned Band {degree}", VERSION, kinds, coefficients, build)


def _angle_labels(degree: int) -> list[str]:
    return [f"{wave} {m} {angle}" for angle in _ANGLES for m in range(1, degree + 1) for wave in ("Cos", "Sin")]


def _angles(tree: Tree, given: Input) -> dict[str, Any]:
    values: list[Any] = []
    for angle in _zyz(tree, given("Turn")):
        for pair in _multiples(tree, angle, MAX_DEGREE):
            values += pair
    return dict(zip(_angle_labels(MAX_DEGREE), values, strict=True))


def _band(tree: Tree, given: Input, *, degree: int) -> dict[str, Any]:
    last, middle, first = (
        [(given(f"Cos {m} {angle}"), given(f"Sin {m} {angle}")) for m in range(1, degree + 1)] for angle in _ANGLES
    )
    to_y = sh_rotation(_QUARTER, degree)[degree - 1]
    values = _about_z(tree, [given(f"C {k}") for k in range(2 * degree + 1)], first)
    values = _times(tree, to_y.T, values)
    values = _about_z(tree, values, middle)
    values = _about_z(tree, _times(tree, to_y, values), last)
    return {f"C {k}": value for k, value in enumerate(values)}


def _zyz(tree: Tree, turn: Any) -> tuple[Any, Any, Any]:
    """Fields of the angles a, b, g of turn = Rz(a) Ry(b) Rz(g); sound at every rotation.

    With the quaternion (w, x, y, z): (a + g) / 2 = atan2(z, w), (a - g) / 2 = atan2(-x, y),
    b / 2 = atan2(|(x, y)|, |(w, z)|). Where one of the sums has no direction, its angle has no effect.
    """
    quat = tree.node("FunctionNodeRotationToQuaternion", {"Rotation": turn})
    w, x, y, z = (tree.output(quat, axis) for axis in "WXYZ")

    def length(p: Any, q: Any) -> Any:
        return tree.math("SQRT", tree.math("MULTIPLY_ADD", p, p, tree.math("MULTIPLY", q, q)))

    half_sum = tree.math("ARCTAN2", z, w)
    half_difference = tree.math("ARCTAN2", tree.math("MULTIPLY", x, -1.0), y)
    middle = tree.math("MULTIPLY", tree.math("ARCTAN2", length(x, y), length(w, z)), 2.0)
    first = tree.math("SUBTRACT", half_sum, half_difference)
    return tree.math("ADD", half_sum, half_difference), middle, first


def _multiples(tree: Tree, angle: Any, degree: int) -> list[tuple[Any, Any]]:
    """cos(m angle) and sin(m angle) for m = 1..degree, as vectors of three equal numbers for products with rgb."""
    one = cosine, sine = tree.math("COSINE", angle), tree.math("SINE", angle)
    found = [one]
    for _ in range(degree - 1):
        c, s = found[-1]
        more = tree.math("SUBTRACT", tree.math("MULTIPLY", c, cosine), tree.math("MULTIPLY", s, sine))
        found.append((more, tree.math("MULTIPLY_ADD", s, cosine, tree.math("MULTIPLY", c, sine))))
    return [(_grey(tree, c), _grey(tree, s)) for c, s in found]


def _grey(tree: Tree, value: Any) -> Any:
    return tree.out("ShaderNodeCombineXYZ", "Vector", dict.fromkeys("XYZ", value))


def _about_z(tree: Tree, band: Band, multiples: list[tuple[Any, Any]]) -> Band:
    """The band turned about z: c'_m = cos(m t) c_m - sin(m t) c_-m and c'_-m = sin(m t) c_m + cos(m t) c_-m."""
    degree = len(band) // 2
    turned = list(band)
    for m in range(1, degree + 1):
        cosine, sine = multiples[m - 1]
        plus, minus = band[degree + m], band[degree - m]
        other = tree.vector("MULTIPLY", sine, minus)
        turned[degree + m] = tree.vector("SUBTRACT", tree.vector("MULTIPLY", cosine, plus), other)
        other = tree.vector("MULTIPLY", sine, plus)
        turned[degree - m] = tree.vector("MULTIPLY_ADD", cosine, minus, other)
    return turned


def _times(tree: Tree, matrix: NDArray[np.float64], band: Band) -> Band:
    """A constant matrix times the band; entries that are zero cost nothing."""
    product = []
    for row in matrix:
        total: Any = None
        for entry, value in zip(row.tolist(), band, strict=True):
            if abs(entry) < 1e-9:
                continue
            if total is not None:
                total = tree.vector("MULTIPLY_ADD", value, (entry,) * 3, total)
            else:
                total = value if abs(entry - 1.0) < 1e-9 else tree.vector("MULTIPLY", value, (entry,) * 3)
        product.append(total)
    return product
