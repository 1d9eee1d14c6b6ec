# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad splats of a splat object: find them, select them, put them aside or remove them, widen needles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.splats.cleanup import clamp_aspect, find_faint_giants, find_needles, find_strays, isotropic
from .attributes import ObjectData
from .selecting import enter_edit_mode
from .splat_object import read_cloud, refuse_edit_mode, replace_cloud

Mask = NDArray[np.bool_]


def find_bad_splats(
    obj: bpy.types.Object, *, strays: bool = True, faint_giants: bool = True, needle_ratio: float = 0.0
) -> tuple[Mask, dict[str, int]]:
    """Mask (N,) of the bad splats of `obj` and the number of each kind; needles only for a ratio over 0."""
    cloud = read_cloud(obj, world=False)
    bad, counts = np.zeros(cloud.count, bool), {}
    found = {
        "strays": find_strays(cloud) if strays else None,
        "faint giants": find_faint_giants(cloud) if faint_giants else None,
        "needles": find_needles(cloud, needle_ratio) if needle_ratio > 0 else None,
    }
    for name, mask in found.items():
        if mask is not None:
            counts[name] = int(mask.sum())
            bad |= mask
    return bad, counts


def begin_selecting(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Make `obj` active and leave Edit Mode, where its splats can neither be read nor selected.

    Raises InputError: in a collection that is excluded, where Blender lets nobody do either.
    """
    if obj.name not in context.view_layer.objects:
        raise InputError(f"'{obj.name}' is in a collection that is excluded; include it in the view layer.")
    context.view_layer.objects.active = obj
    if obj.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


@contextmanager
def out_of_edit_mode(context: bpy.types.Context, obj: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """`begin_selecting`, and the mode of before again where the block is given up. Gives the object. Raises InputError
    as that does, and for a hidden object, whose splats nobody could see selected."""
    _refuse_hidden(context, obj)
    mode = obj.mode
    begin_selecting(context, obj)
    try:
        yield obj
    except BaseException:  # also a generator that is closed
        if obj.mode != mode:
            bpy.ops.object.mode_set(mode=mode)
        raise


def show_selected(context: bpy.types.Context, obj: bpy.types.Object, mask: Mask) -> None:
    """Select exactly the splats of `mask` (N,) of the active object and enter Edit Mode on its points."""
    refuse_edit_mode(obj)
    _refuse_hidden(context, obj)
    enter_edit_mode(context, obj, mask)


def _refuse_hidden(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    if not obj.visible_get(view_layer=context.view_layer):
        raise InputError(f"'{obj.name}' is hidden, or in a collection that is; show it to select its splats.")


def put_aside(obj: bpy.types.Object, mask: Mask) -> bpy.types.Object:
    """Move the splats of `mask` (N,) to a hidden object of their own; Join brings them back."""
    refuse_edit_mode(obj)
    aside = obj.copy()
    aside.data = obj.data.copy()
    aside.name = f"{obj.name} Aside"
    for collection in obj.users_collection:
        collection.objects.link(aside)
    remove_splats(aside, ~mask)
    remove_splats(obj, mask)
    aside.select_set(False)
    aside.hide_set(True)
    aside.hide_render = True
    return aside


def remove_splats(obj: bpy.types.Object, mask: Mask) -> None:
    """Delete the splats of `mask` (N,); the attributes and weights of the others stay."""
    refuse_edit_mode(obj)
    mesh = bmesh.new()
    data: ObjectData = obj.data
    mesh.from_mesh(data)
    mesh.verts.ensure_lookup_table()
    bmesh.ops.delete(mesh, geom=[mesh.verts[int(i)] for i in np.flatnonzero(mask)], context="VERTS")
    mesh.to_mesh(data)
    mesh.free()
    obj.data.update()


def reshape_splats(obj: bpy.types.Object, *, max_aspect: float = 0.0, balls: bool = False) -> int:
    """Widen needles beyond `max_aspect` (0: leave them), or make every splat a ball; the number of needles."""
    cloud, changed = read_cloud(obj, world=False), 0
    if max_aspect > 0:
        cloud, needles = clamp_aspect(cloud, max_aspect)
        changed = int(needles.sum())
    if balls:
        cloud = isotropic(cloud)
    if changed or balls:
        replace_cloud(obj, cloud)
        obj.data.update()
    return changed
