# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that turns every splat with its bones (Eq. 3), so that posing needs no Python.

The Armature modifier moves vertices and leaves the `rotation` attribute. This group samples the bone frames (see
`bone_frames.py`), builds each bone's rotation, blends the quaternions of the splat's strongest bones with their
weights, signs aligned to the first, keeps the result as `gskin:turn` and turns `rotation` by it.
"""

from __future__ import annotations

from typing import Any

import bpy

from . import names
from .node_builder import Tree, add_modifier, find_group, geometry_group, get_input, set_input

VERSION = 2
FRAMES_INPUT = "Bone Frames"


def rotation_group() -> bpy.types.NodeTree:
    """The shared node group "GSkin Rotation"; built once per file."""
    group, new = geometry_group(names.ROTATION_MODIFIER, VERSION, [(FRAMES_INPUT, "NodeSocketObject", {})])
    if new:
        _build(group)
    return group


def find_rotation(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The object's rotation modifier, by its node group and not by its name."""
    return find_group(obj, names.ROTATION_MODIFIER)


def frames_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The bone frames that turn the object's splats."""
    modifier = find_rotation(obj)
    return None if modifier is None else get_input(modifier, FRAMES_INPUT)


def add_rotation(obj: bpy.types.Object, frames: bpy.types.Object, after: bpy.types.Modifier) -> None:
    """Give the object the rotation modifier directly behind `after` (its Armature modifier), or repoint it."""
    modifier = find_rotation(obj)
    if modifier is None:
        modifier = add_modifier(obj, names.ROTATION_MODIFIER)
    modifier.node_group = rotation_group()
    set_input(modifier, FRAMES_INPUT, frames)
    here, there = obj.modifiers.find(modifier.name), obj.modifiers.find(after.name)
    obj.modifiers.move(here, there + 1 if here > there else there)


def _build(group: bpy.types.NodeTree) -> None:
    tree = Tree(group)
    source = tree.node("NodeGroupInput")
    geometry, frames = tree.output(source, "Geometry"), tree.output(source, FRAMES_INPUT)
    info = tree.node("GeometryNodeObjectInfo", {"Object": frames}, transform_space="RELATIVE")
    blended = _blend(tree, tree.output(info, "Geometry"), _bone_turn(tree, tree.output(info, "Rotation")))
    # Stored before it is used: whoever turns the harmonics needs it too, and as a field it would be blended twice.
    geometry = tree.store(geometry, names.TURN, "QUATERNION", blended)
    rest, turn = (tree.attribute(name, "QUATERNION") for name in (names.ROTATION, names.TURN))
    inputs = {"Rotation": rest, "Rotate By": turn}
    rotation = tree.out("FunctionNodeRotateRotation", "Rotation", inputs, rotation_space="GLOBAL")
    tree.node("NodeGroupOutput", {"Geometry": tree.store(geometry, names.ROTATION, "QUATERNION", rotation)})


def _bone_turn(tree: Tree, rest: Any) -> Any:
    """Field over the frames' vertices: at index b, the rotation of bone b in the splat object's space.

    The frames arrive in the splat object's space, so their axes carry its rotation too: `rest`, the rotation
    between the two objects, is taken off on the right.
    """
    index = tree.out("GeometryNodeInputIndex", "Index")
    position = tree.out("GeometryNodeInputPosition", "Position")
    first = tree.math("MULTIPLY", index, 4.0)

    def corner(offset: float) -> Any:
        inputs = {"Value": position, "Index": tree.math("ADD", first, offset)}
        return tree.out("GeometryNodeFieldAtIndex", "Value", inputs, data_type="FLOAT_VECTOR", domain="POINT")

    head = corner(0.0)
    axes = {
        "Primary Axis": tree.vector("SUBTRACT", corner(3.0), head),
        "Secondary Axis": tree.vector("SUBTRACT", corner(1.0), head),
    }
    posed = tree.out("FunctionNodeAxesToRotation", "Rotation", axes, primary_axis="Z", secondary_axis="X")
    inverse = tree.out("FunctionNodeInvertRotation", "Rotation", {"Rotation": rest})
    inputs = {"Rotation": posed, "Rotate By": inverse}
    return tree.out("FunctionNodeRotateRotation", "Rotation", inputs, rotation_space="LOCAL")


def _blend(tree: Tree, frames: Any, turn: Any) -> Any:
    """The weighted sum of the bones' quaternions, as a rotation (which normalises it)."""
    total_w: Any = None
    total_v: Any = None
    first_w: Any = None
    first_v: Any = None
    for slot in range(names.INFLUENCES):
        bone = tree.attribute(names.BONE.format(slot), "INT")
        weight = tree.attribute(names.WEIGHT.format(slot), "FLOAT")
        inputs = {"Geometry": frames, "Value": turn, "Index": bone}
        sampled = tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="QUATERNION", domain="POINT")
        quat = tree.node("FunctionNodeRotationToQuaternion", {"Rotation": sampled})
        w = tree.output(quat, "W")
        v = tree.out("ShaderNodeCombineXYZ", "Vector", {axis: tree.output(quat, axis) for axis in "XYZ"})
        if slot == 0:
            first_w, first_v = w, v
            total_w, total_v = tree.math("MULTIPLY", w, weight), tree.scale(v, weight)
            continue
        agree = tree.math("MULTIPLY_ADD", w, first_w, tree.vector("DOT_PRODUCT", v, first_v))
        signed = tree.math("MULTIPLY", weight, tree.math("MULTIPLY_ADD", tree.math("LESS_THAN", agree, 0.0), -2.0, 1.0))
        total_w = tree.math("MULTIPLY_ADD", w, signed, total_w)
        total_v = tree.vector("ADD", total_v, tree.scale(v, signed))
    parts = tree.node("ShaderNodeSeparateXYZ", {"Vector": total_v})
    squared = tree.math("MULTIPLY_ADD", total_w, total_w, tree.vector("DOT_PRODUCT", total_v, total_v))
    length = tree.math("SQRT", squared)
    inputs = {axis: tree.math("DIVIDE", tree.output(parts, axis), length) for axis in "XYZ"}
    inputs["W"] = tree.math("DIVIDE", total_w, length)
    return tree.out("FunctionNodeQuaternionToRotation", "Rotation", inputs)
