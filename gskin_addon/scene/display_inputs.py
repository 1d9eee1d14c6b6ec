# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be set on the display modifier."""

from __future__ import annotations

from typing import Any

from .display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF
from .native_nodes import has_native_splats

DISPLAY = "Display"
NATIVE = "Native Splats"
LIMIT = "Viewport Limit"
SIZE = "Size"
MINIMUM_OPACITY = "Minimum Opacity"
FACING = "Face Camera"
OCTAHEDRA = "Octahedra"
BY_SHADER = "Drawn by Shader"
"""True while the shader of `viewport/` draws the object; nothing else sets it, and no saved file has it."""

VIEWPORT_LIMIT = 100_000

_NATIVE: tuple[str, str, dict[str, Any]] = (
    NATIVE,
    "NodeSocketBool",
    {"default_value": True, "description": "Draw Blender's own Gaussian splats in every engine; off, ellipsoids"},
)

_SHOWN: list[tuple[str, str, dict[str, Any]]] = [
    (
        DISPLAY,
        "NodeSocketBool",
        {"default_value": True, "description": "Draw the splats; off, the object is its bare points"},
    ),
    *([_NATIVE] if has_native_splats() else []),
    (
        LIMIT,
        "NodeSocketInt",
        {
            "default_value": VIEWPORT_LIMIT,
            "min_value": 1,
            "description": "Most splats drawn in the viewport, those that hide most; of ellipsoids some of all parts. "
            "Renders draw every one",
        },
    ),
    (
        SIZE,
        "NodeSocketFloat",
        {"default_value": 1.0, "min_value": 0.0, "max_value": 10.0, "description": "Factor on the size of every splat"},
    ),
    (
        MINIMUM_OPACITY,
        "NodeSocketFloat",
        {
            "default_value": 0.25,
            "min_value": 0.0,
            "max_value": 1.0,
            "subtype": "FACTOR",
            "description": "Splats below this opacity are not drawn in the viewport, where all look opaque",
        },
    ),
    (
        FACING,
        "NodeSocketBool",
        {
            "default_value": True,
            "description": "Renders draw each splat as a disc that faces the scene's camera, blended in the right "
            "order; off, as an ellipsoid, which mirrors show whole",
        },
    ),
    (
        SHOW_BONES,
        "NodeSocketBool",
        {"default_value": False, "description": "Colour every splat by the bones that turn it, not as captured"},
    ),
    (
        SHOW_CONFIDENCE,
        "NodeSocketBool",
        {
            "default_value": False,
            "description": "Colour every splat by how sure its weights are, from red (touch up here) to blue (sure)",
        },
    ),
    (
        SHOW_WEIGHTS_OF,
        "NodeSocketString",
        {"description": "Bone whose weights are shown, from blue (0) to red (1); empty for none"},
    ),
]


DISPLAY_INPUTS = tuple(label for label, _, _ in _SHOWN)
"""Labels of what can be set, in the order of the modifier."""

_HIDDEN: list[tuple[str, str, dict[str, Any]]] = [
    (OCTAHEDRA, "NodeSocketObject", {"hide_in_modifier": True}),
    (BY_SHADER, "NodeSocketBool", {"default_value": False, "hide_in_modifier": True}),
]

INPUTS = [*_SHOWN, *_HIDDEN]
"""All inputs of the node group after the geometry: label, type of socket, properties."""
