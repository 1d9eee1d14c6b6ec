# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that turns every splat with its bones (Eq. 3), so that posing needs no Python.

The Armature modifier moves vertices and leaves the `rotation` attribute. This group samples the bone frames (see
`bone_frames.py`), builds each bone's rotation, blends the quaternions of the splat's strongest bones with their
weights, signs aligned to the first, keeps the result as `gskin:turn` and turns `rotation` by it. In poses in which
bones are more than rotations, `stretch_nodes.py` changes turn, rotation and scale of their splats. What more than one
armature's vertex groups moves is turned by probes instead (`probes.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from ..core.rig.stretch import RIGID
from . import names
from .bone_frames import has_joints
from .frame_nodes import bone_points, bounds, choose, frame_parts
from .node_algebra import parts
from .node_builder import (
    Input,
    Tree,
    add_modifier,
    existing_group,
    find_group,
    function_group,
    geometry_group,
    get_input,
    set_input,
)
from .probe_nodes import PROBES, STEP, probed_parts, probed_splats, same_number
from .steps import Steps, part_of
from .stretch_nodes import influences, stretch_parts, stretched_splats

VERSIONS = {False: 5, True: 6}
"""Of the group, without and with what bendy bones need: it takes a third of a second to build."""
PROBED = {False: 7, True: 8}
"""Of the group that takes probes as well, without and with what bendy bones need."""
GROUPS = 2
"""Version of the groups inside."""
FRAMES_INPUT = "Bone Frames"


def rotation_group(*, bendy: bool = False) -> bpy.types.NodeTree:
    """The shared node group "GSkin Rotation", with `bendy` for bones with segments; built once per file."""
    inputs: list[Any] = [(FRAMES_INPUT, "NodeSocketObject", {})]
    group, new = geometry_group(names.ROTATION_MODIFIER, VERSIONS[bendy], inputs)
    if new:
        _build(group, bendy)
    return group


def rotation_steps(*, bendy: bool = False) -> Steps[bpy.types.NodeTree]:
    """`rotation_group` in slices: its parts are groups of their own, each built in one slice."""
    built = existing_group(names.ROTATION_MODIFIER, VERSIONS[bendy])
    parts = () if built else (*frame_parts(), *stretch_parts(bendy=bendy), _turned_group, _STRETCHED[bendy])
    for number, part in enumerate(parts):
        part()
        yield (number + 1) / (len(parts) + 1)
    return rotation_group(bendy=bendy)


def probed_group(*, bendy: bool = False) -> bpy.types.NodeTree:
    """The node group "GSkin Rotation" for splats with probes (`probes.py`).

    Where there are not as many probes as splats, it does what `rotation_group` does, whose inputs it has, too.
    """
    inputs: list[Any] = [(label, "NodeSocketObject", {}) for label in (FRAMES_INPUT, *PROBES)]
    inputs.append((STEP, "NodeSocketFloat", {}))
    group, new = geometry_group(names.ROTATION_MODIFIER, PROBED[bendy], inputs)
    if new:
        tree = Tree(group)
        source = tree.node("NodeGroupInput")
        splats = tree.output(source, "Geometry")
        given = {"Geometry": splats, FRAMES_INPUT: tree.output(source, FRAMES_INPUT)}
        plain = tree.call(rotation_group(bendy=bendy), given)["Geometry"]
        probes = {label: tree.object_geometry(tree.output(source, label)) for label in PROBES}
        probed = probed_splats(tree, splats, probes, tree.output(source, STEP))
        chosen = choose(tree, same_number(tree, splats, probes), plain, probed, "GEOMETRY")
        tree.node("NodeGroupOutput", {"Geometry": chosen})
        tree.lay_out()
    return group


def probed_steps(*, bendy: bool = False) -> Steps[bpy.types.NodeTree]:
    """`probed_group` in slices."""
    yield from part_of(rotation_steps(bendy=bendy), 0.0, 0.6)
    for part in () if existing_group(names.ROTATION_MODIFIER, PROBED[bendy]) else probed_parts():
        part()
        yield 0.8
    return probed_group(bendy=bendy)


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
        rest_in_edit_mode(modifier)
    modifier.node_group = rotation_group(bendy=has_joints(frames))
    set_input(modifier, FRAMES_INPUT, frames)
    here, there = obj.modifiers.find(modifier.name), obj.modifiers.find(after.name)
    obj.modifiers.move(here, there + 1 if here > there else there)


def rest_in_edit_mode(modifier: bpy.types.NodesModifier) -> None:
    """Let the nodes not run in Edit Mode while no splat is drawn there (`viewport/switch.py`): with modifiers that
    deform alone Blender need not make a mesh of what is edited after each click."""
    if modifier.show_in_editmode:
        modifier.show_in_editmode = False


def _build(group: bpy.types.NodeTree, bendy: bool) -> None:
    tree = Tree(group)
    source = tree.node("NodeGroupInput")
    geometry, frames = tree.output(source, "Geometry"), tree.output(source, FRAMES_INPUT)
    info = tree.node("GeometryNodeObjectInfo", {"Object": frames}, transform_space="RELATIVE")
    bones = bone_points(tree, info)
    own, _, size = parts(tree, tree.attribute(names.FRAME_STRETCH, "FLOAT_VECTOR"))
    uneven = tree.math("GREATER_THAN", bounds(tree, bones, own)[1], RIGID)
    smallest, largest = bounds(tree, bones, size)
    apart = tree.math("SUBTRACT", tree.math("DIVIDE", largest, smallest), 1.0)
    odd = tree.math("MAXIMUM", apart, bounds(tree, bones, tree.attribute(names.FRAME_ODD, "FLOAT"))[1])
    inputs = {"Geometry": geometry, "Bones": bones}
    made = [tree.call(part(), inputs)["Geometry"] for part in (_turned_group, _STRETCHED[bendy])]
    scaled = _scaled(tree, made[0], largest)
    # The conditions are single values: what is not asked for is not computed.
    more = choose(tree, tree.math("GREATER_THAN", odd, RIGID), scaled, made[1], "GEOMETRY")
    tree.node("NodeGroupOutput", {"Geometry": choose(tree, uneven, made[0], more, "GEOMETRY")})
    tree.lay_out()


def _splats_group(name: str, build: Callable[[Tree, Input], dict[str, Any]]) -> bpy.types.NodeTree:
    kinds = {"Geometry": "Geometry", "Bones": "Geometry"}
    return function_group(name, GROUPS, kinds, {"Geometry": "Geometry"}, build)


def _turned_group() -> bpy.types.NodeTree:
    return _splats_group("GSkin Turned", _turned)


def _stretched_group() -> bpy.types.NodeTree:
    return _splats_group("GSkin Stretched", _plain)


def _bendy_group() -> bpy.types.NodeTree:
    return _splats_group("GSkin Bendy", _bendy)


_STRETCHED = {False: _stretched_group, True: _bendy_group}
"""By whether bones have segments."""


def _scaled(tree: Tree, turned: Any, factor: Any) -> Any:
    """The turned splats where all bones are rotations times the same scale, as of a rig that is scaled by its root."""
    follows = tree.math("GREATER_THAN", tree.attribute(names.BONE.format(0), "INT"), -0.5)
    own = choose(tree, follows, 1.0, factor, "FLOAT")
    size = tree.scale(tree.attribute(names.SCALE, "FLOAT_VECTOR"), own)
    return tree.store(turned, names.SCALE, "FLOAT_VECTOR", size)


def _turned(tree: Tree, given: Input) -> dict[str, Any]:
    """The splats where all bones are plain rotations."""
    found = []
    for slot in range(names.INFLUENCES):
        bone = tree.attribute(names.BONE.format(slot), "INT")
        inputs = {"Geometry": given("Bones"), "Value": tree.attribute(names.TURN, "QUATERNION"), "Index": bone}
        turn = tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type="QUATERNION", domain="POINT")
        found.append((tree.attribute(names.WEIGHT.format(slot), "FLOAT"), turn))
    # Stored before it is used: whoever turns the harmonics needs it too, and as a field it would be blended twice.
    geometry = tree.store(given("Geometry"), names.TURN, "QUATERNION", _blended(tree, found))
    rest, turn = (tree.attribute(name, "QUATERNION") for name in (names.ROTATION, names.TURN))
    inputs = {"Rotation": rest, "Rotate By": turn}
    rotation = tree.out("FunctionNodeRotateRotation", "Rotation", inputs, rotation_space="GLOBAL")
    return {"Geometry": tree.store(geometry, names.ROTATION, "QUATERNION", rotation)}


def _plain(tree: Tree, given: Input) -> dict[str, Any]:
    """The splats where some bones are more than rotations."""
    return _stretched(tree, given, bendy=False)


def _bendy(tree: Tree, given: Input) -> dict[str, Any]:
    """The splats where some bones are more than rotations, and some have segments."""
    return _stretched(tree, given, bendy=True)


def _stretched(tree: Tree, given: Input, *, bendy: bool) -> dict[str, Any]:
    found = influences(tree, given("Bones"), bendy=bendy)
    blended = _blended(tree, [(each.weight, each.turn) for each in found])
    splats = tree.store(given("Geometry"), names.TURN, "QUATERNION", blended)
    return {"Geometry": stretched_splats(tree, splats, found)}


def _blended(tree: Tree, found: list[tuple[Any, Any]]) -> Any:
    """Eq. 3 for weights and rotations, the strongest first."""
    kinds: dict[str, str] = {}
    inputs: dict[str, Any] = {}
    for slot, (weight, turn) in enumerate(found):
        kinds |= {f"Weight {slot}": "Float", f"Turn {slot}": "Rotation"}
        inputs |= {f"Weight {slot}": weight, f"Turn {slot}": turn}

    def build(tree: Tree, given: Input) -> dict[str, Any]:
        pairs = [(given(f"Weight {slot}"), given(f"Turn {slot}")) for slot in range(len(found))]
        return {"Rotation": _blend(tree, pairs)}

    group = function_group("GSkin Blend", GROUPS, kinds, {"Rotation": "Rotation"}, build)
    return tree.call(group, inputs)["Rotation"]


def _blend(tree: Tree, influences: list[tuple[Any, Any]]) -> Any:
    """The weighted sum of quaternions, given as weight and rotation, the strongest first; normalised, as a rotation."""
    total_w: Any = None
    total_v: Any = None
    first_w: Any = None
    first_v: Any = None
    for slot, (weight, turn) in enumerate(influences):
        quat = tree.node("FunctionNodeRotationToQuaternion", {"Rotation": turn})
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
    node = tree.node("ShaderNodeSeparateXYZ", {"Vector": total_v})
    squared = tree.math("MULTIPLY_ADD", total_w, total_w, tree.vector("DOT_PRODUCT", total_v, total_v))
    length = tree.math("SQRT", squared)
    inputs = {axis: tree.math("DIVIDE", tree.output(node, axis), length) for axis in "XYZ"}
    inputs["W"] = tree.math("DIVIDE", total_w, length)
    return tree.out("FunctionNodeQuaternionToRotation", "Rotation", inputs)
