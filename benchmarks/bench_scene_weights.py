# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning weights into Blender's vertex groups and out again: ways to do it, and what the add-on does.

    python -m benchmarks.bench_scene_weights [--splats 400000] [--bones 50]

Prints a Markdown table: seconds in all and the longest block, in which Blender can neither draw nor listen; both also
in processor time of the one thread, which other work on the machine inflates less. Every way is checked to give the
same float32 weights.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Generator
from typing import Any

import bpy
import numpy as np

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.steps import SLICE
from gskin_addon.scene.vertex_groups import GroupsAside, read_pairs
from gskin_addon.scene.weights import iter_read_weights, iter_update_rotation_weights, iter_write_weights

Steps = Generator[Any, None, Any]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, default=400_000)
    parser.add_argument("--bones", type=int, default=50)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    weights = random_weights(options.splats, options.bones, rng)
    print("| what | way | seconds | longest block | core-seconds | longest block |\n|---|---|---|---|---|---|")
    for way in (add_each_value, bmesh_layer, attribute_to_group):
        obj = bare_object(options.splats)
        report("write groups", way, lambda way=way, obj=obj: way(obj, weights))
        check(obj, weights)
    round_trip(options.splats)
    for way in (loop_over_elements, array_per_point, bmesh_items, geometry_nodes):
        found = report("read groups", way, lambda way=way: way(obj, options.bones))
        assert np.array_equal(found, weights), way
    scene_functions(weights, options.bones, rng)


def report(what: str, way: Callable[..., Steps] | str, start: Callable[[], Steps]) -> Any:
    """Run the slices of a way and print its line; gives what it returns."""
    name = way if isinstance(way, str) else (way.__doc__ or "").rstrip(".")
    bpy.context.view_layer.update()  # what came before is not to be evaluated here
    steps, blocks, result = start(), [], None
    while True:
        wall, core = time.perf_counter(), time.thread_time()
        try:
            next(steps)
        except StopIteration as stop:
            result = stop.value
            steps = None
        blocks.append((time.perf_counter() - wall, time.thread_time() - core))
        if steps is None:
            break
    walls, cores = zip(*blocks, strict=True)
    numbers = f"{sum(walls):.2f} | {max(walls):.3f} | {sum(cores):.2f} | {max(cores):.3f}"
    print(f"| {what} | {name} | {numbers} |", flush=True)
    return result


def random_weights(splats: int, bones: int, rng: np.random.Generator) -> np.ndarray:
    """(N, B) float32, four bones a splat, rows sum to 1."""
    weights = np.zeros((splats, bones), np.float32)
    for first in range(0, splats, SLICE):
        rows = weights[first : first + SLICE]
        index = np.argsort(rng.random(rows.shape, dtype=np.float32), axis=1)[:, :4]
        np.put_along_axis(rows, index, rng.dirichlet(np.ones(4), len(rows)).astype(np.float32), axis=1)
    return weights


def bare_object(splats: int) -> bpy.types.Object:
    """A mesh object of so many points, in no scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = bpy.data.meshes.new("Points")
    mesh.vertices.add(splats)
    return bpy.data.objects.new("Points", mesh)


def check(obj: bpy.types.Object, weights: np.ndarray) -> None:
    """The object has exactly these weights."""
    for first in range(0, len(weights), SLICE):
        part = slice(first, min(first + SLICE, len(weights)))
        row, group, weight = read_pairs(obj, part)
        found = np.zeros_like(weights[part])
        found[row, group] = weight
        assert np.array_equal(found, weights[part])


# --- ways to write


def add_each_value(obj: bpy.types.Object, weights: np.ndarray) -> Steps:
    """`vertex_group.add` for each value, a slice a bone."""
    for bone in range(weights.shape[1]):
        add = obj.vertex_groups.new(name=f"b{bone}").add
        splats = np.flatnonzero(weights[:, bone])
        for splat, weight in zip(splats.tolist(), weights[splats, bone].tolist(), strict=True):
            add((splat,), weight, "REPLACE")
        yield


def bmesh_layer(obj: bpy.types.Object, weights: np.ndarray) -> Steps:
    """The deform layer of bmesh."""
    import bmesh  # in the wheel it exists only once bpy is there

    for bone in range(weights.shape[1]):
        obj.vertex_groups.new(name=f"b{bone}")
    mesh = bmesh.new()
    mesh.from_mesh(obj.data)
    yield
    layer = mesh.verts.layers.deform.verify()
    mesh.verts.ensure_lookup_table()
    for first in range(0, len(weights), SLICE):
        part = weights[first : first + SLICE]
        for vertex, row in zip(mesh.verts[first : first + SLICE], part, strict=True):
            held = vertex[layer]
            for bone in row.nonzero()[0].tolist():
                held[bone] = row[bone]
        yield
    mesh.to_mesh(obj.data)
    mesh.free()


def attribute_to_group(obj: bpy.types.Object, weights: np.ndarray) -> Steps:
    """A float attribute turned into a group (`geometry.attribute_convert`), a slice a bone."""
    with GroupsAside(obj) as groups:
        bones = [f"b{bone}" for bone in range(weights.shape[1])]
        yield from groups.write(bones, lambda bone: weights[:, bone])
        groups.commit()


def round_trip(splats: int) -> None:
    """What bmesh takes besides where the mesh has the attributes of splats with harmonics of degree 3."""
    other = bpy.data.objects.new("Harmonics", bpy.data.meshes.new("Harmonics"))
    other.data.vertices.add(splats)
    for index in range(15):
        other.data.attributes.new(f"sh {index}", "FLOAT_VECTOR", "POINT")

    def steps() -> Steps:
        import bmesh  # in the wheel it exists only once bpy is there

        mesh = bmesh.new()
        mesh.from_mesh(other.data)
        yield
        mesh.to_mesh(other.data)
        mesh.free()

    report("nothing", "bmesh there and back, harmonics of degree 3", steps)


# --- ways to read


def loop_over_elements(obj: bpy.types.Object, bones: int) -> Steps:
    """`group` and `weight` of each element."""
    dense = np.zeros((len(obj.data.vertices), bones), np.float32)
    for first in range(0, len(dense), SLICE):
        vertices = obj.data.vertices[first : first + SLICE]
        counts = [len(vertex.groups) for vertex in vertices]
        pairs = np.array([(e.group, e.weight) for vertex in vertices for e in vertex.groups])
        row = np.repeat(np.arange(first, first + len(counts)), counts)
        dense[row, pairs[:, 0].astype(int)] = pairs[:, 1]
        yield
    return dense


def array_per_point(obj: bpy.types.Object, bones: int) -> Steps:
    """`foreach_get` on each point's groups."""
    dense = np.zeros((len(obj.data.vertices), bones), np.float32)
    for first in range(0, len(dense), SLICE):
        row, group, weight = read_pairs(obj, slice(first, min(first + SLICE, len(dense))))
        dense[first + row, group] = weight
        yield
    return dense


def bmesh_items(obj: bpy.types.Object, bones: int) -> Steps:
    """The deform layer of bmesh."""
    import bmesh  # in the wheel it exists only once bpy is there

    mesh = bmesh.new()
    mesh.from_mesh(obj.data)
    yield
    layer = mesh.verts.layers.deform.active
    dense = np.zeros((len(mesh.verts), bones), np.float32)
    mesh.verts.ensure_lookup_table()
    for first in range(0, len(dense), SLICE):
        items = [vertex[layer].items() for vertex in mesh.verts[first : first + SLICE]]
        row = np.repeat(np.arange(first, first + len(items)), [len(item) for item in items])
        pairs = np.array([pair for item in items for pair in item])
        dense[row, pairs[:, 0].astype(int)] = pairs[:, 1]
        yield
    mesh.free()
    return dense


def geometry_nodes(obj: bpy.types.Object, bones: int) -> Steps:
    """Geometry Nodes that store each group as an attribute, in a scene of their own, five bones a slice."""
    dense = np.zeros((len(obj.data.vertices), bones), np.float32)
    column = np.empty(len(dense), np.float32)
    for first in range(0, bones, 5):
        part = range(first, min(first + 5, bones))
        tree = bpy.data.node_groups.new("Read", "GeometryNodeTree")
        for way in ("INPUT", "OUTPUT"):
            tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
        last = tree.nodes.new("NodeGroupInput").outputs[0]
        for bone in part:
            named = tree.nodes.new("GeometryNodeInputNamedAttribute")
            named.data_type, named.inputs[0].default_value = "FLOAT", f"b{bone}"
            store = tree.nodes.new("GeometryNodeStoreNamedAttribute")
            store.data_type, store.domain, store.inputs["Name"].default_value = "FLOAT", "POINT", f"read {bone}"
            tree.links.new(last, store.inputs["Geometry"])
            tree.links.new(named.outputs["Attribute"], store.inputs["Value"])
            last = store.outputs["Geometry"]
        tree.links.new(last, tree.nodes.new("NodeGroupOutput").inputs[0])
        scene, reader = bpy.data.scenes.new("Read"), bpy.data.objects.new("Read", obj.data)
        scene.collection.objects.link(reader)
        reader.modifiers.new("Read", "NODES").node_group = tree
        layer = scene.view_layers[0]
        layer.update()
        mesh = reader.evaluated_get(layer.depsgraph).data
        for bone in part:
            mesh.attributes[f"read {bone}"].data.foreach_get("value", column)
            dense[:, bone] = column
        bpy.data.objects.remove(reader)
        bpy.data.scenes.remove(scene)
        bpy.data.node_groups.remove(tree)
        yield
    return dense


# --- what the add-on does


def scene_functions(weights: np.ndarray, bones: int, rng: np.random.Generator) -> None:
    """The functions of `gskin_addon.scene.weights` on splats and an armature in a scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    splats = len(weights)
    cloud = SplatCloud(
        means=rng.normal(size=(splats, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (splats, 1)),
        scales=np.full((splats, 3), 0.01, np.float32),
        opacities=np.full(splats, 0.5, np.float32),
        sh=np.zeros((splats, 1, 3), np.float32),
    )
    obj, armature = create_splat_object(cloud, "Splats", display=False), chain(bones)
    for what in ("write_weights", "write_weights over old ones"):
        report(what, "in slices", lambda: iter_write_weights(obj, armature, weights))
    crowded = rng.random((splats, bones), dtype=np.float32)
    report("write_weights, all bones above 0", "in slices", lambda: iter_write_weights(obj, armature, crowded))
    report("read_weights", "in slices", lambda: iter_read_weights(obj))
    report("update_rotation_weights", "in slices", lambda: iter_update_rotation_weights(obj))


def chain(bones: int) -> bpy.types.Object:
    """An armature of so many bones one above the other."""
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for index in range(bones):
        bone = armature.data.edit_bones.new(f"b{index}")
        bone.head, bone.tail = (0, 0, index), (0, 0, index + 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


if __name__ == "__main__":
    main()
