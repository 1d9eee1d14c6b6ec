# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's bone heat (Baran & Popovic 2007; Ctrl-P, With Automatic Weights) on arrays, through bpy."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.rig.skeleton import Skeleton

from .base import Unavailable

Array = NDArray[Any]

SIZE = 20.0
"""Diagonal in Blender units at which the solver runs. Scaling up is the usual cure for its failures: on 24 assets, a
proxy of the diagonal 2 stayed without weights on four, of 20 on one."""


def weld(verts: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Vertices at one place become one, as Merge by Distance does: unwelded seams stop the heat.

    verts (V, 3), faces (F, 3) -> verts (W, 3), faces (G, 3) without those that collapse, and the new vertex (V,) of
    each old one.
    """
    size = float(np.linalg.norm(np.ptp(verts, axis=0))) or 1.0
    _, first, new = np.unique(np.round(verts / (1e-5 * size)).astype(np.int64), axis=0, return_index=True,
                              return_inverse=True)  # fmt: skip
    new = new.ravel()
    welded = new[faces]
    a, b, c = welded.T
    welded = welded[(a != b) & (b != c) & (c != a)]
    _, kept = np.unique(np.sort(welded, axis=1), axis=0, return_index=True)
    return verts[first], welded[np.sort(kept)], new


def bone_heat(verts: Array, faces: Array, skeleton: Skeleton) -> tuple[Array, str]:
    """Weights (V, B) as Blender leaves them, rows of zeros where it found none; and its warning, if any.

    Raises:
        Unavailable: there is no bpy here.
    """
    try:
        import bpy
    except ImportError:
        raise Unavailable("bone heat needs Blender's Python module: pip install bpy") from None
    bpy.ops.wm.read_factory_settings(use_empty=True)
    centre = (verts.max(0) + verts.min(0)) / 2
    scale = SIZE / float(np.linalg.norm(np.ptp(verts, axis=0)))
    mesh = bpy.data.meshes.new("body")
    mesh.from_pydata(((verts - centre) * scale).tolist(), [], faces.tolist())
    mesh.validate()
    body = bpy.data.objects.new("body", mesh)
    bpy.context.collection.objects.link(body)
    rig = _armature(bpy, skeleton, centre, scale)
    for item in (body, rig):
        item.select_set(True)
    bpy.context.view_layer.objects.active = rig
    words = _said_by(lambda: bpy.ops.object.parent_set(type="ARMATURE_AUTO"))
    return _read_groups(body, skeleton), next((w for w in words.splitlines() if "Bone Heat" in w), "")


def _armature(bpy: Any, skeleton: Skeleton, centre: Array, scale: float) -> Any:
    rig = bpy.data.objects.new("rig", bpy.data.armatures.new("rig"))
    bpy.context.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    heads, tails = (skeleton.heads - centre) * scale, (skeleton.tails - centre) * scale
    bones = []
    for number, parent in enumerate(skeleton.parents):
        bone = rig.data.edit_bones.new(f"b{number}")
        bone.head, bone.tail = heads[number], tails[number]
        if bone.length < 1e-4:  # Blender deletes bones without a length
            bone.tail = bone.head + type(bone.head)((0, 0, 1e-3))
        if parent >= 0:
            bone.parent = bones[parent]
        bones.append(bone)
    bpy.ops.object.mode_set(mode="OBJECT")
    return rig


def _read_groups(body: Any, skeleton: Skeleton) -> Array:
    weights = np.zeros((len(body.data.vertices), skeleton.count))
    column = {group.index: int(group.name[1:]) for group in body.vertex_groups}
    for vertex in body.data.vertices:
        for entry in vertex.groups:
            weights[vertex.index, column[entry.group]] = entry.weight
    return weights


def _said_by(task: Callable[[], object]) -> str:
    """What `task` prints; Blender's operators report to the process's output, below Python."""
    sys.stdout.flush()
    with tempfile.TemporaryFile("w+b") as file:
        kept = os.dup(1)
        os.dup2(file.fileno(), 1)
        try:
            task()
        finally:
            sys.stdout.flush()
            os.dup2(kept, 1)
            os.close(kept)
        file.seek(0)
        return file.read().decode("utf-8", "replace")
