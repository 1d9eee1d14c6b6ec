# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats handed to Blender as its own 3D Gaussian Splats (Blender 5.3 and later), as nodes.

A native splat object takes no Armature modifier, so the splats stay a mesh, and a point cloud is made of them at the
end of the modifiers: live, in every engine, without Python. Its attributes have the mesh's names. Blender evaluates
harmonics in the object's own space, so what the bones have turned is turned here (`harmonics_nodes.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain, pairwise
from typing import Any

import bpy

from ..core.splats.cloud import SH_C0
from . import names
from .display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF, splat_srgb
from .harmonics_nodes import MAX_DEGREE, turned_bands
from .node_builder import Input, Tree, function_group
from .sampled import Sampled

VERSION = 1
"""Of the node groups."""

_LABELS = [names.SH.format(k) for k in range((MAX_DEGREE + 1) ** 2 - 1)]
"""Blender draws no higher degree; higher bands are left out."""
_STARTS = [degree**2 - 1 for degree in range(1, MAX_DEGREE + 2)]

POSITION_STEPS = 2**22
"""Into how many steps Blender divides the extent of all splats on each axis; one far splat makes all places coarse."""

NUDGE = 1e-4
"""By how much the first and the last axis are made larger and smaller: exact balls vanish or turn black."""


def has_native_splats() -> bool:
    """Whether this Blender draws Gaussian splats itself."""
    return bpy.app.version >= (5, 3, 0)


def native_group() -> bpy.types.NodeTree:
    """The node group that makes a point cloud of native splats of the mesh `Splats`.

    Size: factor on every splat's size. Show Bones, Show Confidence, Show Weights Of: single values; where one is set,
    the splats have these colours, seen from everywhere, instead of those captured.
    """
    kinds = {"Splats": "Geometry", "Size": "Float", SHOW_BONES: "Bool", SHOW_CONFIDENCE: "Bool",
             SHOW_WEIGHTS_OF: "String"}  # fmt: skip
    return function_group("GSkin Native Splats", VERSION, kinds, {"Points": "Geometry"}, _native)


def native_parts() -> tuple[Callable[[], object], ...]:
    """What builds the groups that `native_group` uses, beside those of colours and of turned harmonics."""
    return _harmonics_group, _stored_group


def _native(tree: Tree, given: Input) -> dict[str, Any]:
    splats = given("Splats")
    own = Sampled(tree, splats, tree.out("GeometryNodeInputIndex", "Index"))
    shown_as = {label: given(label) for label in (SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF)}
    srgb, special = splat_srgb(tree, own, shown_as)
    # New points, and not Mesh to Points, which would copy vertex groups and all else.
    place = own.field(tree.out("GeometryNodeInputPosition", "Position"), "FLOAT_VECTOR")
    inputs = {"Count": tree.domain_size(splats, "MESH"), "Position": place}
    points = tree.out("GeometryNodePoints", "Points", inputs)
    factor = tree.scale((1.0 + NUDGE, 1.0, 1.0 - NUDGE), given("Size"))
    scale = tree.vector("MULTIPLY", own(names.SCALE, "FLOAT_VECTOR"), factor)
    base = own(names.BASE, "FLOAT_COLOR")
    inputs = {"Switch": special, "False": base, "True": _as_base(tree, srgb, base)}
    base = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="RGBA")
    points = tree.store(points, names.ROTATION, "QUATERNION", own(names.ROTATION, "QUATERNION"))
    points = tree.store(points, names.SCALE, "FLOAT_VECTOR", scale)
    points = tree.store(points, names.BASE, "FLOAT_COLOR", base)
    harmonics = tree.call(_harmonics_group(), own.given)
    whole = tree.call(_stored_group(), {"Splats": splats, "Points": points, **harmonics})["Points"]
    inputs = {"Switch": special, "False": whole, "True": points}
    points = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    return {"Points": tree.out("GeometryNodePointsSetType", "Points", {"Points": points, "Type": "3D Gaussian Splat"})}


def _as_base(tree: Tree, srgb: Any, base: Any) -> Any:
    """Colours as the constant harmonic's coefficients, with the splats' opacity."""
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": tree.vector("SUBTRACT", srgb, (0.5,) * 3)})
    channels = {
        name: tree.math("DIVIDE", tree.output(parts, axis), SH_C0)
        for name, axis in (("Red", "X"), ("Green", "Y"), ("Blue", "Z"))
    }
    channels["Alpha"] = tree.output(tree.node("FunctionNodeSeparateColor", {"Color": base}), "Alpha")
    return tree.out("FunctionNodeCombineColor", "Color", channels)


def _harmonics_group() -> bpy.types.NodeTree:
    """The node group of all coefficients above the constant, turned where bones turn the splats."""
    values = dict.fromkeys(_LABELS, "Vector")
    return function_group("GSkin Turned Harmonics", VERSION, Sampled.SOCKETS, values, _harmonics)


def _harmonics(tree: Tree, given: Input) -> dict[str, Any]:
    own = Sampled.within(tree, given)
    rest = [own(label, "FLOAT_VECTOR") for label in _LABELS]
    bands = [rest[start:end] for start, end in pairwise(_STARTS)]
    turned = chain.from_iterable(turned_bands(tree, bands, own(names.TURN, "QUATERNION")))
    is_turned = own.has(names.TURN, "QUATERNION")
    shown = {}
    for label, one, other in zip(_LABELS, rest, turned, strict=True):
        inputs = {"Switch": is_turned, "False": one, "True": other}
        shown[label] = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    return shown


def _stored_group() -> bpy.types.NodeTree:
    """The node group that stores as many bands on `Points` as the mesh `Splats` has."""
    kinds = {"Splats": "Geometry", "Points": "Geometry", **dict.fromkeys(_LABELS, "Vector")}
    return function_group("GSkin Stored Harmonics", VERSION, kinds, {"Points": "Geometry"}, _all_stored)


def _all_stored(tree: Tree, given: Input) -> dict[str, Any]:
    points = result = given("Points")
    for start, end in pairwise(_STARTS):
        stored = _stored(tree, points, _LABELS[:end], [given(label) for label in _LABELS[:end]])
        has_band = tree.has(given("Splats"), _LABELS[start], "FLOAT_VECTOR")
        inputs = {"Switch": has_band, "False": result, "True": stored}
        result = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    return {"Points": result}


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
