# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats handed to Blender as its own 3D Gaussian Splats (Blender 5.3 and later), as nodes.

A native splat object takes no Armature modifier, so the splats stay a mesh, and a point cloud is made of them at the
end of the modifiers: live, in every engine, without Python. Its attributes have the mesh's names. Blender evaluates
harmonics in the object's own space, so what the bones have turned is turned here (`harmonics_nodes.py`).
"""

from __future__ import annotations

from itertools import chain, pairwise
from typing import Any

import bpy

from ..core.splats.cloud import SH_C0
from . import names
from .harmonics_nodes import turned_bands
from .node_builder import Tree

MAX_DEGREE = 3
"""Highest degree that Blender draws; higher bands are left out."""

POSITION_STEPS = 2**22
"""Into how many steps Blender divides the extent of all splats on each axis; one far splat makes all places coarse."""

NUDGE = 1e-4
"""By how much the first and the last axis are made larger and smaller: exact balls vanish or turn black."""


def has_native_splats() -> bool:
    """Whether this Blender draws Gaussian splats itself."""
    return bpy.app.version >= (5, 3, 0)


def native_splats(tree: Tree, splats: Any, size: Any, special: Any, srgb: Any) -> Any:
    """A point cloud of native splats made of the mesh `splats`, as a geometry.

    size: factor on every splat's size. special, srgb: a single boolean and a field over the points; where true, the
    splats have these colours, seen from everywhere, instead of those captured.
    """
    index = tree.out("GeometryNodeInputIndex", "Index")

    def sampled(value: Any, kind: str) -> Any:
        inputs = {"Geometry": splats, "Value": value, "Index": index}
        return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    def own(name: str, kind: str) -> Any:
        return sampled(tree.attribute(name, kind), kind)

    # New points, and not Mesh to Points, which would copy vertex groups and all else.
    place = sampled(tree.out("GeometryNodeInputPosition", "Position"), "FLOAT_VECTOR")
    inputs = {"Count": tree.domain_size(splats, "MESH"), "Position": place}
    points = tree.out("GeometryNodePoints", "Points", inputs)
    factor = tree.scale((1.0 + NUDGE, 1.0, 1.0 - NUDGE), size)
    scale = tree.vector("MULTIPLY", own(names.SCALE, "FLOAT_VECTOR"), factor)
    base = own(names.BASE, "FLOAT_COLOR")
    inputs = {"Switch": special, "False": base, "True": _as_base(tree, srgb, base)}
    base = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="RGBA")
    points = tree.store(points, names.ROTATION, "QUATERNION", own(names.ROTATION, "QUATERNION"))
    points = tree.store(points, names.SCALE, "FLOAT_VECTOR", scale)
    points = tree.store(points, names.BASE, "FLOAT_COLOR", base)
    inputs = {"Switch": special, "False": _with_harmonics(tree, splats, points, own), "True": points}
    points = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    return tree.out("GeometryNodePointsSetType", "Points", {"Points": points, "Type": "3D Gaussian Splat"})


def _as_base(tree: Tree, srgb: Any, base: Any) -> Any:
    """Colours as the constant harmonic's coefficients, with the splats' opacity."""
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": tree.vector("SUBTRACT", srgb, (0.5,) * 3)})
    channels = {
        name: tree.math("DIVIDE", tree.output(parts, axis), SH_C0)
        for name, axis in (("Red", "X"), ("Green", "Y"), ("Blue", "Z"))
    }
    channels["Alpha"] = tree.output(tree.node("FunctionNodeSeparateColor", {"Color": base}), "Alpha")
    return tree.out("FunctionNodeCombineColor", "Color", channels)


def _with_harmonics(tree: Tree, splats: Any, points: Any, own: Any) -> Any:
    """The points with as many bands as the mesh has, turned where bones turn them."""
    labels = [names.SH.format(k) for k in range((MAX_DEGREE + 1) ** 2 - 1)]
    rest = [own(label, "FLOAT_VECTOR") for label in labels]
    starts = [degree**2 - 1 for degree in range(1, MAX_DEGREE + 2)]
    bands = [rest[start:end] for start, end in pairwise(starts)]
    turned = chain.from_iterable(turned_bands(tree, bands, own(names.TURN, "QUATERNION")))
    is_turned = _has(tree, splats, names.TURN, "QUATERNION")
    shown = []
    for one, other in zip(rest, turned, strict=True):
        inputs = {"Switch": is_turned, "False": one, "True": other}
        shown.append(tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR"))
    result = points
    for start, end in pairwise(starts):
        stored = _stored(tree, points, labels[:end], shown[:end])
        has_band = _has(tree, splats, labels[start], "FLOAT_VECTOR")
        inputs = {"Switch": has_band, "False": result, "True": stored}
        result = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    return result


def _stored(tree: Tree, points: Any, labels: list[str], values: list[Any]) -> Any:
    """The points with all fields stored. Captured first, all at once: each store alone would turn the whole band."""
    capture: Any = tree.node("GeometryNodeCaptureAttribute", domain="POINT")
    for label in labels:
        capture.capture_items.new("VECTOR", label)
    tree.connect(points, tree.input(capture, "Geometry"))
    for label, value in zip(labels, values, strict=True):
        tree.connect(value, tree.input(capture, label))
    points = tree.output(capture, "Geometry")
    for label in labels:
        points = tree.store(points, label, "FLOAT_VECTOR", tree.output(capture, label))
    return points


def _has(tree: Tree, geometry: Any, name: str, kind: str) -> Any:
    """Whether the geometry has an attribute, as a single boolean: looked up at its first point."""
    exists = tree.out("GeometryNodeInputNamedAttribute", "Exists", {"Name": name}, data_type=kind)
    inputs = {"Geometry": geometry, "Value": exists, "Index": 0}
    return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="BOOLEAN", domain="POINT")
