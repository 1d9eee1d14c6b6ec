# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that draws splats as coloured ellipsoids.

In the viewport they are octahedra of one mesh, which Blender draws fast and which show their colours in Solid mode
too; in renders they are instances of a sphere whose material fades like the Gaussian itself.
"""

from __future__ import annotations

import math
from typing import Any

import bpy

from . import names
from .display_colors import SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF, splat_color
from .materials import FAINTEST, render_material, viewport_material
from .node_builder import Tree, add_modifier, find_group, geometry_group, get_input, set_input

VERSION = 2

VIEWPORT_LIMIT = 100_000
VIEWPORT_SIGMAS = 1.6
"""Radius of a splat drawn solid. A Gaussian stops to hide what is behind it at about 1.2 standard deviations; an
octahedron needs more to cover as much, and with less a surface shows holes."""

_INPUTS: list[tuple[str, str, dict[str, Any]]] = [
    (
        "Display",
        "NodeSocketBool",
        {"default_value": True, "description": "Draw ellipsoids; off, the object is its bare points"},
    ),
    (
        "Viewport Limit",
        "NodeSocketInt",
        {
            "default_value": VIEWPORT_LIMIT,
            "min_value": 1,
            "description": "Most splats drawn in the viewport, spread evenly over all; renders draw every one",
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


def display_group() -> bpy.types.NodeTree:
    """The shared node group "GSkin Display"; built once per file."""
    group, new = geometry_group(names.DISPLAY_MODIFIER, VERSION, _INPUTS)
    if new:
        _build(group)
    return group


def find_display(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The object's display modifier, by its node group and not by its name."""
    return find_group(obj, names.DISPLAY_MODIFIER)


def add_display(obj: bpy.types.Object) -> bpy.types.NodesModifier:
    """Give the object the display modifier, last in its stack; an existing one is kept."""
    modifier = find_display(obj)
    if modifier is None:
        modifier = add_modifier(obj, names.DISPLAY_MODIFIER)
        modifier.node_group = display_group()
        # In Edit Mode the artist needs the points themselves.
        modifier.show_in_editmode = False
    obj.modifiers.move(obj.modifiers.find(modifier.name), len(obj.modifiers) - 1)
    return modifier


def set_display(obj: bpy.types.Object, name: str, value: Any) -> None:
    """Set an input of the display by its label, one of `DISPLAY_INPUTS`, as "Display" or "Viewport Limit"."""
    set_input(add_display(obj), name, value)


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

    count = tree.out("GeometryNodeAttributeDomainSize", "Point Count", {"Geometry": splats}, component="MESH")
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
    shown_as = (tree.output(source, label) for label in (SHOW_BONES, SHOW_CONFIDENCE, SHOW_WEIGHTS_OF))
    color = splat_color(tree, sampled, *shown_as)
    points = tree.out("GeometryNodePoints", "Points", {"Count": shown, "Position": sampled("position", "FLOAT_VECTOR")})
    points = tree.out(
        "GeometryNodeStoreNamedAttribute",
        "Geometry",
        {"Geometry": points, "Name": names.COLOR, "Value": color},
        data_type="FLOAT_COLOR",
        domain="POINT",
    )

    visible = tree.out(
        "FunctionNodeCompare",
        "Result",
        {"A": opacity, "B": tree.output(source, "Minimum Opacity")},
        data_type="FLOAT",
        operation="GREATER_EQUAL",
    )
    rotation, scale = sampled(names.ROTATION, "QUATERNION"), sampled(names.SCALE, "FLOAT_VECTOR")

    def instances(shape: Any, sigmas: Any, selection: Any) -> Any:
        inputs = {
            "Points": points,
            "Instance": shape,
            "Selection": selection,
            "Rotation": rotation,
            "Scale": tree.scale(scale, tree.math("MULTIPLY", size, sigmas)),
        }
        return tree.out("GeometryNodeInstanceOnPoints", "Instances", inputs)

    octahedron = tree.out("GeometryNodeObjectInfo", "Geometry", {"Object": _octahedron()}, transform_space="ORIGINAL")
    # Fewer splats are drawn larger, so that the surface stays closed.
    wider = tree.math("MULTIPLY", tree.math("SQRT", tree.math("MINIMUM", step, 9.0)), VIEWPORT_SIGMAS)
    solid = tree.out("GeometryNodeRealizeInstances", "Geometry", {"Geometry": instances(octahedron, wider, visible)})

    sphere = tree.out("GeometryNodeMeshIcoSphere", "Mesh", {"Radius": 1.0, "Subdivisions": 2})
    sphere = tree.out("GeometryNodeSetMaterial", "Geometry", {"Geometry": sphere, "Material": render_material()})
    # The radius, in standard deviations, that `render_material` takes the sphere to have.
    ratio = tree.math("MAXIMUM", tree.math("MULTIPLY", opacity, 1 / FAINTEST), 1.0)
    reach = tree.math("SQRT", tree.math("MULTIPLY", tree.math("LOGARITHM", ratio, math.e), 2.0))
    soft = instances(sphere, reach, tree.math("GREATER_THAN", reach, 0.0))

    inputs = {"Switch": in_viewport, "False": soft, "True": solid}
    drawn = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    inputs = {"Switch": tree.output(source, "Display"), "False": splats, "True": drawn}
    result = tree.out("GeometryNodeSwitch", "Output", inputs, input_type="GEOMETRY")
    tree.node("NodeGroupOutput", {"Geometry": result})


def _octahedron() -> bpy.types.Object:
    """The viewport's shape: a helper in no collection, like the bone frames.

    A primitive node would do but for the colours: Solid mode shows the *active* colour attribute, nodes cannot choose
    it, and Realize Instances takes the choice from the instanced mesh. The attribute itself comes with the instances.
    """
    mesh = bpy.data.meshes.new("GSkin Octahedron")
    corners = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    mesh.from_pydata(corners, [], faces)
    mesh.materials.append(viewport_material())
    mesh.color_attributes.active_color_name = names.COLOR
    return bpy.data.objects.new(mesh.name, mesh)
