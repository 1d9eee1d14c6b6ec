# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of drawn splats, as nodes: as captured, by their bones, by confidence, or by the weights of one bone."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.splats.cloud import SH_C0
from . import names
from .node_builder import Input, Tree, function_group
from .sampled import Sampled
from .seen_color import seen_color

SHOW_BONES = "Show Bones"
SHOW_CONFIDENCE = "Show Confidence"
SHOW_WEIGHTS_OF = "Show Weights Of"

VERSION = 1
"""Of the node groups inside."""
_SHOWN_AS = {SHOW_BONES: "Bool", SHOW_CONFIDENCE: "Bool", SHOW_WEIGHTS_OF: "String"}


def splat_color(tree: Tree, sampled: Sampled, shown_as: dict[str, Any], *, seen: bool = False) -> Any:
    """Field of linear colour and opacity of the drawn points; see `splat_srgb`."""
    srgb, _ = splat_srgb(tree, sampled, shown_as, seen=seen)
    base = sampled(names.BASE, "FLOAT_COLOR")
    alpha = tree.output(tree.node("FunctionNodeSeparateColor", {"Color": base}), "Alpha")
    return tree.call(linear_group(), {"Color": srgb, "Alpha": alpha})["Color"]


def splat_srgb(tree: Tree, sampled: Sampled, shown_as: dict[str, Any], *, seen: bool = False) -> tuple[Any, Any]:
    """Field of sRGB colour as a vector, and whether it is another than the captured one (a single boolean).

    shown_as: single values of `SHOW_BONES`, `SHOW_CONFIDENCE` and `SHOW_WEIGHTS_OF`, so only the chosen colours are
    computed. seen: captured colours are those that the camera sees (`seen_color.py`), not the constant ones alone.
    """
    captured = seen_color(tree, sampled) if seen else _captured(tree, sampled(names.BASE, "FLOAT_COLOR"))
    made = tree.call(shown_group(), {**sampled.given, "Captured": captured, **shown_as})
    return made["Color"], made["Special"]


def shown_group() -> bpy.types.NodeTree:
    """The node group that chooses between captured and explaining colours."""
    kinds = {**Sampled.SOCKETS, "Captured": "Vector", **_SHOWN_AS}
    return function_group("GSkin Shown Color", VERSION, kinds, {"Color": "Vector", "Special": "Bool"}, _shown)


def _shown(tree: Tree, given: Input) -> dict[str, Any]:
    sampled = Sampled.within(tree, given)
    show_bones, show_confidence, show_weights_of = (given(label) for label in _SHOWN_AS)
    by_bones = tree.call(by_bones_group(), sampled.given)["Color"]
    inputs = {"Switch": show_bones, "False": given("Captured"), "True": by_bones}
    srgb = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    # One more switch of colours would cost every frame; what is shown as heat is chosen by its name instead.
    inputs = {"Switch": show_confidence, "False": show_weights_of, "True": names.CONFIDENCE}
    heat_of = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="STRING")
    named = tree.out(
        "FunctionNodeCompare", "Result", {"A": heat_of, "B": ""}, data_type="STRING", operation="NOT_EQUAL"
    )
    # Doubt is hot: 1 - confidence.
    heat = tree.math("ABSOLUTE", tree.math("SUBTRACT", sampled(heat_of, "FLOAT"), show_confidence))
    inputs = {"Switch": named, "False": srgb, "True": _heat(tree, heat)}
    srgb = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="VECTOR")
    special = tree.out("FunctionNodeBooleanMath", "Boolean", {0: named, 1: show_bones}, operation="OR")
    return {"Color": srgb, "Special": special}


def _captured(tree: Tree, base: Any) -> Any:
    """clip(0.5 + C0 f_dc), as a vector."""
    srgb = tree.vector("MULTIPLY_ADD", base, (SH_C0,) * 3, (0.5,) * 3)
    return tree.vector("MINIMUM", tree.vector("MAXIMUM", srgb, (0.0,) * 3), (1.0,) * 3)


def by_bones_group() -> bpy.types.NodeTree:
    """The node group of the palette of `core.rig.colors`, mixed by the stored weights; without a bone black."""
    return function_group("GSkin Bone Color", VERSION, Sampled.SOCKETS, {"Color": "Vector"}, _by_bones)


def _by_bones(tree: Tree, given: Input) -> dict[str, Any]:
    sampled = Sampled.within(tree, given)
    total: Any = (0.0, 0.0, 0.0)
    for slot in range(names.INFLUENCES):
        bone = sampled(names.BONE.format(slot), "INT")
        weight = sampled(names.WEIGHT.format(slot), "FLOAT")
        weight = tree.math("MULTIPLY", weight, tree.math("GREATER_THAN", bone, -0.5))
        hue = tree.math("FRACT", tree.math("MULTIPLY_ADD", bone, 0.6180339887498949, 0.02))
        odd = tree.math("FLOORED_MODULO", bone, 2.0)
        second = tree.math("COMPARE", tree.math("FLOORED_MODULO", bone, 3.0), 1.0, 0.1)
        # By place: the sockets are called Red, Green and Blue in every mode.
        channels = {
            0: hue,
            1: tree.math("MULTIPLY_ADD", second, -0.25, 0.80),
            2: tree.math("MULTIPLY_ADD", odd, -0.17, 0.95),
        }
        color = tree.out("FunctionNodeCombineColor", "Color", channels, mode="HSV")
        total = tree.vector("ADD", total, tree.scale(color, weight))
    return {"Color": total}


def _heat(tree: Tree, weight: Any) -> Any:
    """Blue at 0 over green to red at 1, as Weight Paint has it."""
    clipped = tree.out("ShaderNodeClamp", "Result", {"Value": weight, "Min": 0.0, "Max": 1.0})
    hue = tree.math("MULTIPLY_ADD", clipped, -2 / 3, 2 / 3)
    return tree.out("FunctionNodeCombineColor", "Color", {0: hue, 1: 1.0, 2: 1.0}, mode="HSV")


def linear_group() -> bpy.types.NodeTree:
    """The node group that decodes sRGB, a vector, to Blender's linear colours, with alpha."""
    kinds = {"Color": "Vector", "Alpha": "Float"}
    return function_group("GSkin Linear Color", VERSION, kinds, {"Color": "Color"}, _linear)


def _linear(tree: Tree, given: Input) -> dict[str, Any]:
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": given("Color")})
    channels = {"Alpha": given("Alpha")}
    for name, axis in (("Red", "X"), ("Green", "Y"), ("Blue", "Z")):
        value = tree.output(parts, axis)
        power = tree.math("POWER", tree.math("MULTIPLY_ADD", value, 1 / 1.055, 0.055 / 1.055), 2.4)
        dark = tree.math("LESS_THAN", value, 0.04045)
        straight = tree.math("SUBTRACT", tree.math("DIVIDE", value, 12.92), power)
        channels[name] = tree.math("MULTIPLY_ADD", dark, straight, power)
    return {"Color": tree.out("FunctionNodeCombineColor", "Color", channels)}
