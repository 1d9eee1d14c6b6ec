# SPDX-License-Identifier: GPL-3.0-or-later
"""Spherical harmonics of degree 1 to 3 turned by one quaternion per splat, as nodes.

A rotation about z mixes only the coefficients m and -m of a band, and every rotation is Rz(a) Ry(b) Rz(g) with
Ry(b) = K Rz(b) K^T, K the quarter turn about x that takes z to y. So a band is turned by Z(a) K Z(b) K^T Z(g) with
constant, sparse K: far fewer nodes than dense matrices, and none has to be stored.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.splats.sh import sh_rotation
from .node_builder import Tree

_QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""K: z to y."""

Band = list[Any]
"""Fields of the 2 l + 1 coefficients of a band, rgb each."""


def turned_bands(tree: Tree, bands: list[Band], turn: Any) -> list[Band]:
    """The bands l = 1, 2, ... of coefficient fields, turned by the rotation field `turn`: f'(d) = f(turn^-1 d).

    The same as `core.splats.sh.rotate_sh`, in 32 bits.
    """
    last, middle, first = (_multiples(tree, angle, len(bands)) for angle in _zyz(tree, turn))
    quarter = sh_rotation(_QUARTER, len(bands))
    turned = []
    for band, to_y in zip(bands, quarter, strict=True):
        values = _about_z(tree, band, first)
        values = _times(tree, to_y.T, values)
        values = _about_z(tree, values, middle)
        values = _times(tree, to_y, values)
        turned.append(_about_z(tree, values, last))
    return turned


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
