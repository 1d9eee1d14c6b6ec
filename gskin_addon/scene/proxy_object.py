# SPDX-License-Identifier: GPL-3.0-or-later
"""A proxy mesh with learned weights as an object of the scene, and anchored splats in its present pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.anchoring import pose_anchored
from ..core.splats.cloud import SplatCloud
from .anchored import attach, find_anchors, has_edges_only, proxy_of, read_anchors
from .attributes import read_positions
from .binding import follow
from .bone_frames import armature_of
from .splat_object import read_cloud, refuse_edit_mode, to_world
from .steps import Steps, part_of, run_to_end
from .vertex_groups import GroupsAside
from .weights import NewWeights

Array = NDArray[Any]


def create_mesh_object(name: str, verts: Array, faces: Array) -> bpy.types.Object:
    """A mesh object of verts (V, 3), world, and faces (F, 3) for splats to hang on.

    It is drawn as wires and not rendered: the splats are what is seen.
    """
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(verts, float).tolist(), [], np.asarray(faces).tolist())
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    obj.display_type, obj.hide_render = "WIRE", True
    return obj


def bind_proxy(obj: bpy.types.Object, armature: bpy.types.Object, weights: Array, bones: Sequence[str]) -> None:
    """Let `armature` move the mesh object by weights (V, B): vertex groups, parent (in place), Armature modifier.

    Vertex groups of these bones are replaced, others stay, and so does another parent. The object gets a new mesh
    datablock of the same name. Raises InputError where the mesh has other points.
    """
    _check(obj, weights)
    with GroupsAside(obj) as groups:
        run_to_end(groups.write(bones, lambda bone: weights[:, bone]))
        follow(groups.check(), armature, keep_parent=True)
        groups.commit()


def iter_write_weights_through(
    obj: bpy.types.Object,
    proxy: bpy.types.Object,
    armature: bpy.types.Object,
    weights: Array,
    mesh_weights: Array,
    bones: Sequence[str],
    *,
    max_influences: int = 4,
    confidence: Array | None = None,
    edges_only: bool = False,
) -> Steps[None]:
    """Let `armature` move the mesh object `proxy` by mesh_weights (V, B), and the splats of `obj` hang on it.

    The splats keep weights (N, B) of their own as vertex groups. In slices, of which only the last changes the
    scene; finding where the splats hang is one of them, long for many splats. edges_only: as in `anchor_to_mesh`.

    Raises InputError as `write_weights`, `bind_proxy` and `anchor_to_mesh` do; nothing is written then.
    """
    _check(proxy, mesh_weights)
    given = (obj, armature, weights, bones)
    options: dict[str, Any] = {"max_influences": max_influences, "confidence": confidence}
    with NewWeights(*given, **options) as new, GroupsAside(proxy) as groups:
        yield from part_of(groups.write(bones, lambda bone: mesh_weights[:, bone]), 0.0, 0.2)
        yield from part_of(new.make(), 0.2, 0.9)
        obj, armature = new.check()
        # Refusals come before anything is changed.
        proxy = groups.check()
        found = find_anchors(obj, proxy)
        new.commit(carried=True)
        follow(proxy, armature, keep_parent=True)
        groups.commit()
        attach(obj, proxy, *found, edges_only=edges_only)


def _check(obj: bpy.types.Object, weights: Array) -> None:
    refuse_edit_mode(obj)
    if len(weights) != len(obj.data.vertices):
        raise InputError(
            f"'{obj.name}' has {len(obj.data.vertices)} points and the weights are for {len(weights)}; "
            "make them again for the mesh as it is."
        )


def followed_armature(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The armature that moves the splats, directly or through the mesh that they are anchored to."""
    proxy = proxy_of(obj)
    return armature_of(obj if proxy is None else proxy)


def posed_anchored(obj: bpy.types.Object) -> SplatCloud:
    """Anchored splats in world space as their proxy lies now, by the core's formulas (float64).

    Raises InputError: not anchored, or the proxy's points are no longer those that were anchored to.
    """
    anchors, verts, faces = read_anchors(obj)
    proxy = proxy_of(obj)
    bpy.context.view_layer.update()
    evaluated = proxy.evaluated_get(bpy.context.evaluated_depsgraph_get())
    posed = read_positions(evaluated.data).astype(np.float64)
    if len(posed) != len(verts):
        raise InputError(
            f"'{proxy.name}' has {len(posed)} points and had {len(verts)} when '{obj.name}' was anchored to it; "
            "undo the change or anchor again."
        )
    matrix = np.linalg.inv(np.array(obj.matrix_world)) @ np.array(evaluated.matrix_world)
    posed = posed @ matrix[:3, :3].T + matrix[:3, 3]
    cloud = read_cloud(obj, world=False)
    return to_world(pose_anchored(cloud, anchors, verts, posed, faces, edges_only=has_edges_only(obj)), obj)
