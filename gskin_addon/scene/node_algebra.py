# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear algebra of 3 x 3 matrices in node trees: a matrix is three vectors, its columns."""

from __future__ import annotations

from typing import Any

from .node_builder import Input, Tree, function_group

VERSION = 1
"""Of the node groups: what is used again and again is one."""
POLAR_STEPS = 6

Columns = list[Any]


def jacobi(tree: Tree, a: Any, b: Any) -> tuple[Any, Any]:
    """Two columns turned into each other until they are orthogonal (`core.rig.covariance.orthogonal_axes`)."""
    pair = dict.fromkeys("AB", "Vector")
    made = tree.call(function_group("GSkin Jacobi", VERSION, pair, pair, _jacobi), {"A": a, "B": b})
    return made["A"], made["B"]


def _jacobi(tree: Tree, given: Input) -> dict[str, Any]:
    a, b = given("A"), given("B")
    aa, bb, ab = (tree.vector("DOT_PRODUCT", *pair) for pair in ((a, a), (b, b), (a, b)))
    difference = tree.math("SUBTRACT", bb, aa)
    twice = tree.math("MULTIPLY", ab, 2.0)
    root = tree.math("SQRT", tree.math("MULTIPLY_ADD", difference, difference, tree.math("MULTIPLY", twice, twice)))
    root = tree.math("ADD", tree.math("ABSOLUTE", difference), root)
    sign = tree.math("MULTIPLY_ADD", tree.math("LESS_THAN", difference, 0.0), -2.0, 1.0)
    t = tree.math("DIVIDE", tree.math("MULTIPLY", sign, twice), root)  # 0 / 0 is 0 in these nodes
    c = tree.math("INVERSE_SQRT", tree.math("MULTIPLY_ADD", t, t, 1.0))
    s = tree.math("MULTIPLY", c, t)
    first = tree.vector("SUBTRACT", tree.scale(a, c), tree.scale(b, s))
    return {"A": first, "B": tree.vector("ADD", tree.scale(a, s), tree.scale(b, c))}


def parts(tree: Tree, vector: Any) -> Columns:
    node = tree.node("ShaderNodeSeparateXYZ", {"Vector": vector})
    return [tree.output(node, axis) for axis in "XYZ"]


def vector(tree: Tree, parts: Columns) -> Any:
    return tree.out("ShaderNodeCombineXYZ", "Vector", dict(zip("XYZ", parts, strict=True)))


def combine(tree: Tree, vectors: Columns, factors: Columns) -> Any:
    """sum_k factors[k] vectors[k]."""
    total = tree.scale(vectors[0], factors[0])
    for vector, factor in zip(vectors[1:], factors[1:], strict=True):
        total = tree.vector("ADD", total, tree.scale(vector, factor))
    return total


def polar_rotation(tree: Tree, columns: Columns) -> Columns:
    """Columns of the R in T = R S, by Newton's iteration.

    A mirrored T (a ring turned inside out) gives a reflection here and a rotation in the core.
    """
    kinds = dict.fromkeys("XYZ", "Vector")
    step = function_group("GSkin Polar Iteration", VERSION, kinds, kinds, _polar_iteration)
    for _ in range(POLAR_STEPS):
        columns = [*tree.call(step, dict(zip("XYZ", columns, strict=True))).values()]
    return columns


def _polar_iteration(tree: Tree, given: Input) -> dict[str, Any]:
    """X <- (X + X^-T) / 2, from unit determinant."""
    columns = [given(axis) for axis in "XYZ"]
    a, b, c = columns
    cofactor = [tree.vector("CROSS_PRODUCT", *pair) for pair in ((b, c), (c, a), (a, b))]
    determinant = tree.vector("DOT_PRODUCT", a, cofactor[0])
    factor = tree.math("POWER", tree.math("ABSOLUTE", determinant), -1 / 3)
    old = tree.math("MULTIPLY", factor, 0.5)
    new = tree.math("DIVIDE", 0.5, tree.math("MULTIPLY", factor, determinant))
    pairs = zip(columns, cofactor, strict=True)
    new_columns = [tree.vector("ADD", tree.scale(axis, old), tree.scale(other, new)) for axis, other in pairs]
    return dict(zip("XYZ", new_columns, strict=True))
