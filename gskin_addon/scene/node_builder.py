# SPDX-License-Identifier: GPL-3.0-or-later
"""Short words for building node trees by code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import bpy

Value = Any
"""An output socket, or a constant for the input it goes to."""
Input = Callable[[str], Value]
"""Inside a node group: its input of a label."""


class Tree:
    """A node tree being built: each call adds one node and returns an output socket."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def node(self, kind: str, inputs: Mapping[Any, Value] | None = None, **properties: Any) -> bpy.types.Node:
        """Add a node; `properties` are set first, because they decide which sockets exist."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            self.connect(value, self.input(node, key))
        return node

    def lay_out(self) -> None:
        """Put the nodes on a plain grid: nobody edits these by hand, but whoever opens the group should see them all.

        All at once, because Blender looks at the whole tree after each node that is moved alone.
        """
        nodes: Any = self.tree.nodes
        places = [(220.0 * (number // 6), -260.0 * (number % 6)) for number in range(len(nodes))]
        nodes.foreach_set("location", [value for place in places for value in place])

    @staticmethod
    def input(node: bpy.types.Node, key: str | int) -> bpy.types.NodeSocket:
        """The input socket at a place, or the one in use among those of that name."""
        if isinstance(key, int):
            return node.inputs[key]
        return next(s for s in node.inputs if s.name == key and s.enabled)

    @staticmethod
    def output(node: bpy.types.Node, key: str) -> bpy.types.NodeSocket:
        """The output socket in use among those of that name."""
        return next(s for s in node.outputs if s.name == key and s.enabled)

    def connect(self, value: Value, socket: Any) -> None:
        """Link a socket to an input, or set the input to a constant."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        else:
            socket.default_value = value

    def out(self, kind: str, name: str, inputs: Mapping[Any, Value] | None = None, **properties: Any) -> Value:
        """Add a node and return its output `name`."""
        return self.output(self.node(kind, inputs, **properties), name)

    def math(self, operation: str, *values: Value) -> Value:
        """A float operation."""
        return self.out("ShaderNodeMath", "Value", dict(enumerate(values)), operation=operation)

    def vector(self, operation: str, *values: Value) -> Value:
        """A vector operation; DOT_PRODUCT and LENGTH give a float."""
        node = self.node("ShaderNodeVectorMath", dict(enumerate(values)), operation=operation)
        return next(s for s in node.outputs if s.enabled)

    def scale(self, vector: Value, factor: Value) -> Value:
        """A vector times a float."""
        inputs = {"Vector": vector, "Scale": factor}
        return self.out("ShaderNodeVectorMath", "Vector", inputs, operation="SCALE")

    def attribute(self, name: str, kind: str) -> Value:
        """A named attribute of a geometry, by Blender's attribute type."""
        return self.out("GeometryNodeInputNamedAttribute", "Attribute", {"Name": name}, data_type=kind)

    def store(self, geometry: Value, name: str, kind: str, value: Value) -> Value:
        """The geometry with a field stored on its points as a named attribute."""
        inputs = {"Geometry": geometry, "Name": name, "Value": value}
        return self.out("GeometryNodeStoreNamedAttribute", "Geometry", inputs, data_type=kind, domain="POINT")

    def has(self, geometry: Value, name: str, kind: str) -> Value:
        """Whether the geometry has an attribute on its points, as a single boolean: looked up at the first one."""
        exists = self.out("GeometryNodeInputNamedAttribute", "Exists", {"Name": name}, data_type=kind)
        inputs = {"Geometry": geometry, "Value": exists, "Index": 0}
        return self.out("GeometryNodeSampleIndex", "Value", inputs, data_type="BOOLEAN", domain="POINT")

    def object_geometry(self, obj: Value) -> Value:
        """An object's evaluated geometry in its own space."""
        return self.out("GeometryNodeObjectInfo", "Geometry", {"Object": obj}, transform_space="ORIGINAL")

    def call(self, group: bpy.types.NodeTree, inputs: Mapping[str, Value]) -> dict[str, Value]:
        """A node group as a node, with its inputs by label; gives its outputs by label."""
        node = self.node("GeometryNodeGroup", inputs, node_tree=group)
        return {socket.name: socket for socket in node.outputs if socket.enabled and socket.name}

    def domain_size(self, geometry: Value, component: str) -> Value:
        """The number of points of a mesh or point cloud."""
        inputs = {"Geometry": geometry}
        return self.out("GeometryNodeAttributeDomainSize", "Point Count", inputs, component=component)


def existing_group(name: str, version: int) -> bpy.types.NodeTree | None:
    """Our own node group of this name and version, where the file has it."""
    group: Any
    for group in bpy.data.node_groups:
        if group.get("gskin_group") == name and group.get("gskin_version") == version and group.library is None:
            return group
    return None


def geometry_group(name: str, version: int, inputs: list[tuple[str, str, dict[str, Any]]]) -> tuple[Any, bool]:
    """The geometry node group of this name and version, and whether it is new and still empty.

    inputs: (name, socket type, properties) after the geometry. A group of another version (an older file's) is left
    alone for the objects that use it.
    """
    group: Any
    group = existing_group(name, version)
    if group is not None:
        return group, False
    group = bpy.data.node_groups.new(name, "GeometryNodeTree")
    group["gskin_group"], group["gskin_version"] = name, version
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    for label, kind, properties in inputs:
        socket = group.interface.new_socket(label, in_out="INPUT", socket_type=kind)
        for key, value in properties.items():
            setattr(socket, key, value)
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    return group, True


def function_group(
    name: str,
    version: int,
    inputs: Mapping[str, str],
    outputs: Mapping[str, str],
    build: Callable[[Tree, Input], Mapping[str, Value]],
) -> bpy.types.NodeTree:
    """The node group of this name and version, for use inside others; built where there is none.

    inputs, outputs: kind of socket ("Vector") by label. build(tree, input) gives the outputs, input(label) an input.
    What is used more than once is a group of its own: Blender takes the square of a tree's size to build it.
    """
    group: Any = existing_group(name, version)
    if group is not None:
        return group
    group = bpy.data.node_groups.new(name, "GeometryNodeTree")
    group["gskin_group"], group["gskin_version"] = name, version
    for way, sockets in (("INPUT", inputs), ("OUTPUT", outputs)):
        for label, kind in sockets.items():
            group.interface.new_socket(label, in_out=way, socket_type=f"NodeSocket{kind}")
    tree = Tree(group)
    source = tree.node("NodeGroupInput")
    tree.node("NodeGroupOutput", build(tree, lambda label: tree.output(source, label)))
    tree.lay_out()
    return group


def find_group(obj: bpy.types.Object, name: str) -> bpy.types.NodesModifier | None:
    """The object's modifier with our node group `name`, whatever the modifier or the group are called by now."""
    modifier: Any
    for modifier in obj.modifiers:
        group = modifier.node_group if modifier.type == "NODES" else None
        if group is not None and group.get("gskin_group") == name:
            return modifier
    return None


def add_modifier(obj: bpy.types.Object, name: str) -> bpy.types.NodesModifier:
    """A new modifier for a node group, last in the stack and closed in the properties editor."""
    modifier: Any = obj.modifiers.new(name, "NODES")
    modifier.show_expanded = False
    return modifier


def input_property(modifier: bpy.types.NodesModifier, name: str) -> tuple[Any, str]:
    """Owner and path under which a panel can show a node group's input, found by its label."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):  # Blender 5.2 and later
        return getattr(modifier.properties.inputs, identifier), "value"
    return modifier, f'["{identifier}"]'


def set_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Set a node group's input on a modifier by its label."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value
    modifier.id_data.update_tag()


def has_input(modifier: bpy.types.NodesModifier, name: str) -> bool:
    """Whether the modifier's node group has an input of this label; a group from an older file may lack it."""
    items: Any = modifier.node_group.interface.items_tree
    return any(i.item_type == "SOCKET" and i.in_out == "INPUT" and i.name == name for i in items)


def get_input(modifier: bpy.types.NodesModifier, name: str) -> Any:
    """The value of a node group's input on a modifier by its label."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):
        return getattr(modifier.properties.inputs, identifier).value
    return modifier.get(identifier)


def input_values(modifier: bpy.types.NodesModifier) -> dict[str, Any]:
    """Values of all inputs of a modifier's node group that can be set on it, by their identifiers; arrays as tuples."""
    found: dict[str, Any] = {}
    items: Any = modifier.node_group.interface.items_tree
    for item in items:
        if item.item_type != "SOCKET" or item.in_out != "INPUT":
            continue
        if hasattr(modifier, "properties"):
            value = getattr(getattr(modifier.properties.inputs, item.identifier, None), "value", None)
        else:
            value = modifier.get(item.identifier)
        found[item.identifier] = tuple(value) if hasattr(value, "__len__") and not isinstance(value, str) else value
    return found


def _identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    item: Any
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            return str(item.identifier)
    raise KeyError(f"node group '{modifier.node_group.name}' has no input '{name}'")
