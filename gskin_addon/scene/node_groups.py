# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that draws splats: as Blender's own (5.3 and later, `native_nodes.py`), or as coloured ellipsoids.

Ellipsoids: in the viewport they are octahedra of one mesh, which Blender draws fast and which show their colours in
Solid mode too; in renders they are instances of a sphere whose material fades like the Gaussian itself.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import bpy
import numpy as np

from . import names
from .attributes import read_attribute
from .display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF, splat_color, splat_srgb
from .native_nodes import has_native_splats, native_splats
from .node_builder import Tree, add_modifier, find_group, geometry_group, get_input, has_input, set_input
from .octahedra import CORNERS, ensure_octahedra, octahedra_count
from .seen_color import seen_color
from .soft_nodes import soft_splats
from .viewport.nodes import shader_points

VERSION = 5

VIEWPORT_LIMIT = 100_000
VIEWPORT_SIGMAS = 1.6
"""Radius of a splat drawn solid. A Gaussian stops to hide what is behind it at about 1.2 standard deviations; an
octahedron needs more to cover as much, and with less a surface shows holes."""

NATIVE = "Native Splats"
_NATIVE_INPUT: tuple[str, str, dict[str, Any]] = (
    NATIVE,
    "NodeSocketBool",
    {"default_value": True, "description": "Draw Blender's own Gaussian splats in every engine; off, ellipsoids"},
)

FACING = "Face Camera"

_INPUTS: list[tuple[str, str, dict[str, Any]]] = [
    (
        "Display",
        "NodeSocketBool",
        {"default_value": True, "description": "Draw the splats; off, the object is its bare points"},
    ),
    *([_NATIVE_INPUT] if has_native_splats() else []),
    (
        "Viewport Limit",
        "NodeSocketInt",
        {
            "default_value": VIEWPORT_LIMIT,
            "min_value": 1,
            "description": "Most splats drawn in the viewport, those that hide most; of ellipsoids some of all parts. "
            "Renders draw every one",
        },
    ),
    (
        "Size",
        "NodeSocketFloat",
        {"default_value": 1.0, "min_value": 0.0, "max_value": 10.0, "description": "Factor on the size of every splat"},
    ),
    (
        "Minimum Opacity",
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


DISPLAY_INPUTS = tuple(label for label, _, _ in _INPUTS)
"""Labels of what can be set, in the order of the modifier."""

OCTAHEDRA = "Octahedra"
BY_SHADER = "Drawn by Shader"
"""True while the shader of `viewport/` draws the object; nothing else sets it, and no saved file has it."""

_HIDDEN: list[tuple[str, str, dict[str, Any]]] = [
    (OCTAHEDRA, "NodeSocketObject", {"hide_in_modifier": True}),
    (BY_SHADER, "NodeSocketBool", {"default_value": False, "hide_in_modifier": True}),
]


def display_group() -> bpy.types.NodeTree:
    """The shared node group "GSkin Display"; built once per file."""
    group, new = geometry_group(names.DISPLAY_MODIFIER, VERSION, [*_INPUTS, *_HIDDEN])
    if new:
        _build(group)
    return group


def find_display(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The object's display modifier, by its node group and not by its name."""
    return find_group(obj, names.DISPLAY_MODIFIER)


def draws_native(obj: bpy.types.Object) -> bool:
    """Whether the object is drawn as Blender's own splats (5.3 and later)."""
    modifier = find_display(obj)
    return modifier is not None and has_input(modifier, NATIVE) and bool(get_input(modifier, NATIVE))


def add_display(obj: bpy.types.Object) -> bpy.types.NodesModifier:
    """Give the object the display modifier, last in its stack; an existing one is kept."""
    modifier = find_display(obj)
    if modifier is None:
        modifier = add_modifier(obj, names.DISPLAY_MODIFIER)
        modifier.node_group = display_group()
        # In Edit Mode the artist needs the points themselves.
        modifier.show_in_editmode = False
        match_octahedra(obj)
    obj.modifiers.move(obj.modifiers.find(modifier.name), len(obj.modifiers) - 1)
    return modifier


def renew_display(obj: bpy.types.Object) -> None:
    """Give a display of an older file the present node group; what was set stays."""
    modifier = add_display(obj)
    kept = {name: get_input(modifier, name) for name in DISPLAY_INPUTS if has_input(modifier, name)}
    modifier.node_group = display_group()
    for name, value in kept.items():
        set_input(modifier, name, value)
    match_octahedra(obj)


def set_display(obj: bpy.types.Object, name: str, value: Any) -> None:
    """Set an input of the display by its label, one of `DISPLAY_INPUTS`, as "Display" or "Viewport Limit"."""
    set_input(add_display(obj), name, value)
    match_octahedra(obj)


def get_display(obj: bpy.types.Object, name: str) -> Any:
    """Read an input of the display; None where the object has no display modifier."""
    modifier = find_display(obj)
    return None if modifier is None else get_input(modifier, name)


def _build(group: bpy.types.NodeTree) -> None:
    tree = Tree(group)
    source = tree.node("NodeGroupInput")
    splats = tree.output(source, "Geometry")
    size = tree.output(source, "Size")
    in_viewport = tree.out("GeometryNodeIsViewport", "Is Viewport")

    count = tree.domain_size(splats, "MESH")
    limited = tree.math("MINIMUM", count, tree.output(source, "Viewport Limit"))
    inputs = {"Switch": in_viewport, "False": count, "True": limited}
    shown = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="INT")
    step = tree.math("DIVIDE", count, shown)
    index = tree.out("GeometryNodeInputIndex", "Index")
    splat = tree.math("FLOOR", tree.math("MULTIPLY", index, step))

    def sampled(name: Any, kind: str) -> Any:
        # Sampling from new points instead of deleting and instancing the splats' own: nothing copies their
        # up to 75 SH attributes.
        inputs = {"Geometry": splats, "Value": tree.attribute(name, kind), "Index": splat}
        return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    base = sampled(names.BASE, "FLOAT_COLOR")
    opacity = tree.output(tree.node("FunctionNodeSeparateColor", {"Color": base}), "Alpha")
    shown_as = [tree.output(source, label) for label in (SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF)]
    color = splat_color(tree, sampled, *shown_as, seen=partial(seen_color, tree, splats, sampled))
    points = tree.out("GeometryNodePoints", "Points", {"Count": shown, "Position": sampled("position", "FLOAT_VECTOR")})

    points = tree.store(points, names.COLOR, "FLOAT_COLOR", color)
    rotation, scale = sampled(names.ROTATION, "QUATERNION"), sampled(names.SCALE, "FLOAT_VECTOR")

    def instances(shape: Any, factor: Any, selection: Any) -> Any:
        inputs = {
            "Points": points,
            "Instance": shape,
            "Selection": selection,
            "Rotation": rotation,
            "Scale": tree.scale(scale, factor),
        }
        return tree.out("GeometryNodeInstanceOnPoints", "Instances", inputs)

    # Fewer splats are drawn larger, so that the surface stays closed.
    wider = tree.math("MULTIPLY", tree.math("SQRT", tree.math("MINIMUM", step, 9.0)), VIEWPORT_SIGMAS)
    wider = tree.math("MULTIPLY", size, wider)
    faint = tree.math("LESS_THAN", opacity, tree.output(source, "Minimum Opacity"))
    placed = tree.store(points, names.ROTATION, "QUATERNION", rotation)
    placed = tree.store(placed, names.SCALE, "FLOAT_VECTOR", scale)
    inputs = {"Geometry": placed, "Selection": faint}
    seen = tree.out("GeometryNodeDeleteGeometry", "Geometry", inputs, domain="POINT")
    borrowed = tree.object_geometry(tree.output(source, OCTAHEDRA))
    # Where the settings were just changed, the helper may have another number; then faces are made the slow way.
    corners = tree.math("MULTIPLY", tree.domain_size(seen, "POINTCLOUD"), float(CORNERS))
    operands = {0: corners, 1: tree.domain_size(borrowed, "MESH"), 2: 0.5}
    fits = tree.out("ShaderNodeMath", "Value", operands, operation="COMPARE")
    bright = tree.math("SUBTRACT", 1.0, faint)
    made = instances(tree.object_geometry(ensure_octahedra(1)), wider, bright)
    made = tree.out("GeometryNodeRealizeInstances", "Geometry", {"Geometry": made})
    inputs = {"Switch": fits, "False": made, "True": _place(tree, borrowed, seen, wider)}
    solid = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")

    soft = soft_splats(tree, placed, opacity, size, tree.output(source, FACING))

    bare = shader_points(tree, splats, shown_as, partial(splat_color, tree))
    inputs = {"Switch": tree.output(source, BY_SHADER), "False": solid, "True": bare}
    solid = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    inputs = {"Switch": in_viewport, "False": soft, "True": solid}
    drawn = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    if has_native_splats():
        inputs = {"Switch": tree.output(source, NATIVE), "False": drawn, "True": _native(tree, source)}
        drawn = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    # Without a display nothing is seen of the fabric either, see `fabric.py`.
    inputs = {"Geometry": splats}
    bare = tree.out("GeometryNodeDeleteGeometry", "Geometry", inputs, domain="EDGE", mode="EDGE_FACE")
    inputs = {"Switch": tree.output(source, "Display"), "False": bare, "True": drawn}
    result = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    tree.node("NodeGroupOutput", {"Geometry": result})


def _native(tree: Tree, source: Any) -> Any:
    """All splats as Blender's own, in the viewport too."""
    splats = tree.output(source, "Geometry")
    index = tree.out("GeometryNodeInputIndex", "Index")

    def sampled(name: Any, kind: str) -> Any:
        inputs = {"Geometry": splats, "Value": tree.attribute(name, kind), "Index": index}
        return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    shown_as = (SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF)
    bones, confidence, weights = (tree.output(source, label) for label in shown_as)
    srgb, special = splat_srgb(tree, sampled, bones, confidence, weights)
    return native_splats(tree, splats, tree.output(source, "Size"), special, srgb)


def _place(tree: Tree, octahedra: Any, points: Any, factor: Any) -> Any:
    """Octahedron i moved, turned, sized and coloured as point i says."""
    index = tree.out("GeometryNodeInputIndex", "Index")
    # Indices are whole, so that the half keeps rounding away from the next octahedron.
    point = tree.math("FLOOR", tree.math("DIVIDE", tree.math("ADD", index, 0.5), float(CORNERS)))

    def at_corner(name: str, kind: str) -> Any:
        inputs = {"Geometry": points, "Value": tree.attribute(name, kind), "Index": point}
        return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")

    corner = tree.scale(tree.out("GeometryNodeInputPosition", "Position"), factor)
    corner = tree.vector("MULTIPLY", corner, at_corner(names.SCALE, "FLOAT_VECTOR"))
    inputs = {"Vector": corner, "Rotation": at_corner(names.ROTATION, "QUATERNION")}
    corner = tree.out("FunctionNodeRotateVector", "Vector", inputs)
    corner = tree.vector("ADD", corner, at_corner("position", "FLOAT_VECTOR"))
    placed = tree.out("GeometryNodeSetPosition", "Geometry", {"Geometry": octahedra, "Position": corner})
    return tree.store(placed, names.COLOR, "FLOAT_COLOR", at_corner(names.COLOR, "FLOAT_COLOR"))


def match_octahedra(obj: bpy.types.Object) -> None:
    """Give the display as many octahedra as splats are seen in the viewport; then it is drawn fast.

    Called where the settings or the splats change; nothing depends on it but speed.
    """
    modifier = find_display(obj)
    if modifier is None or not has_input(modifier, OCTAHEDRA):
        return
    seen = _count_seen(obj, get_input(modifier, "Viewport Limit"), get_input(modifier, "Minimum Opacity"))
    if octahedra_count(get_input(modifier, OCTAHEDRA)) != seen:
        set_input(modifier, OCTAHEDRA, ensure_octahedra(seen) if seen else None)


def _count_seen(obj: bpy.types.Object, limit: int, least: float) -> int:
    """As the nodes choose, in float32 as they do."""
    base = read_attribute(obj.data, names.BASE)
    if base is None or len(base) == 0:
        return 0
    shown = min(len(base), limit)
    splat = np.floor(np.arange(shown, dtype=np.float32) * (np.float32(len(base)) / np.float32(shown))).astype(np.int64)
    return int(np.count_nonzero(base[splat, 3] >= np.float32(least)))
