# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer Weights from a skinned mesh to splats whose weights are lost, and To Mesh from the splats to a bare one."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from addon import part, turned_as_computed
from arriving import choose
from stage import Story

from .desk import Desk

CLOSE = 0.1
"""Mean summed difference of weights, 0 to 2, that a transfer there and back may cost."""


def transferring(desk: Desk) -> Story:
    """There, and back."""
    stage = desk.stage
    stage.chapter = "transfer"
    right = desk.weights()
    mesh = surface(desk, "Surface", right)
    bare = surface(desk, "Bare", None)
    lost = np.zeros_like(right)
    lost[:, desk.column("hips")] = 1
    part("scene.weights").write_weights(desk.splats, desk.rig, lost, desk.bones)
    mesh.hide_set(True)
    bare.hide_set(True)
    desk.look()
    yield from desk.settled()
    yield from desk.hands.shoot("w60_lost")
    mesh.hide_set(False)
    choose(desk.view, desk.splats, mesh)
    yield from desk.buttons.show("weights")
    if (yield from desk.buttons.press("gskin.transfer_weights", "Transfer Weights", 60.0)):
        mesh.hide_set(True)
        got = desk.weights()
        changed = int((got != lost).any(axis=1).sum())
        stage.check("Transfer Weights changes splats", changed > 0.5 * len(got), f"{changed:,}")
        off = float(np.abs(got - right).sum(axis=1).mean())
        stage.check("they have the weights of the mesh", off < CLOSE, f"{off:.3f} apart in the mean")
        sums = float(np.abs(got.sum(axis=1) - 1).max())
        stage.check("Transfer Weights: sums stay 1", sums < 1e-3, f"{sums:.1e}")
        yield from desk.settled()
        stage.check("rotations follow the transfer", turned_as_computed(desk.splats))
        yield from desk.hands.shoot("w61_transferred")
    mesh.hide_set(True)
    bare.hide_set(False)
    choose(desk.view, desk.splats, bare)
    yield 0.5
    if (yield from desk.buttons.press("gskin.transfer_weights_to_mesh", "To Mesh", 60.0)):
        got = groups_of(desk, bare)
        off = float(np.abs(got - right[used(desk)]).sum(axis=1).mean())
        stage.check("To Mesh gives the mesh the weights", off < CLOSE, f"{off:.3f} apart in the mean")
        stage.check("the mesh follows the armature", bare.find_armature() == desk.rig, bare.find_armature())
    for obj in (mesh, bare):
        bpy.data.objects.remove(obj)


def used(desk: Desk) -> np.ndarray:
    """(M,) the splats at the fabric's corners, in order."""
    return np.unique(triangles(desk))


def triangles(desk: Desk) -> np.ndarray:
    """(T, 3) the fabric."""
    corners = np.empty(3 * len(desk.splats.data.polygons), np.int32)
    desk.splats.data.polygons.foreach_get("vertices", corners)
    return corners.reshape(-1, 3)


def surface(desk: Desk, name: str, weights: np.ndarray | None) -> Any:
    """A mesh of the fabric's triangles, with vertex groups where weights (N, B) are given, and smooth as meshes are."""
    points, splats, faces = desk.points(), used(desk), triangles(desk)
    number = np.full(len(points), -1)
    number[splats] = np.arange(len(splats))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points[splats].tolist(), [], number[faces].tolist())
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    if weights is not None:
        for column, bone in enumerate(desk.bones):
            group = obj.vertex_groups.new(name=bone)
            values = weights[splats, column]
            for index in np.flatnonzero(values).tolist():
                group.add([index], float(values[index]), "REPLACE")
    return obj


def groups_of(desk: Desk, obj: Any) -> np.ndarray:
    """(M, B) the weights of a mesh."""
    out = np.zeros((len(obj.data.vertices), len(desk.bones)), np.float32)
    names = [group.name for group in obj.vertex_groups]
    for vertex in obj.data.vertices:
        for element in vertex.groups:
            if names[element.group] in desk.bones:
                out[vertex.index, desk.column(names[element.group])] = element.weight
    return out
