# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat objects that Blender made itself, taken over without loss.

Blender 5.3 imports splats (.ply, .spz, .usd) as point clouds of the type Gaussian Splat, which take neither vertex
groups nor an Armature modifier. As a mesh with the same attributes they do. Names, order and meaning of the attributes
are ours (`names.py`); only the colours have another type, and further columns their bare names.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.rig.quaternion import normalize
from ..core.splats.cloud import MAX_SH_DEGREE, SplatCloud
from . import names
from .attributes import ObjectData, read_attribute, read_positions
from .node_groups import add_display
from .render import prepare_scene
from .splat_object import is_splat_object, refuse_edit_mode, replace_cloud

_OWN = ("position", names.ROTATION, names.SCALE, names.BASE)
_COLUMNS = ("FLOAT", "INT", "BOOLEAN")
"""Types of attributes that are kept as a file's further columns; others stay on the mesh as they are."""


def is_blender_splats(obj: bpy.types.Object | None) -> bool:
    """Whether `obj` holds splats that are not yet ours: Blender's point cloud, or the mesh it was converted to."""
    if obj is None or obj.type not in {"POINTCLOUD", "MESH"} or is_splat_object(obj):
        return False
    data: ObjectData = obj.data
    if obj.type == "POINTCLOUD" and getattr(data, "type", "") == "GAUSSIAN_SPLAT":
        return True
    return all(name in data.attributes and data.attributes[name].domain == "POINT" for name in _OWN)


def make_riggable(context: bpy.types.Context, obj: bpy.types.Object) -> bpy.types.Object:
    """Turn Blender's splat object `obj` into a splat object that an armature can move; gives it back.

    It stays the same object: name, transform, parent, constraints, animation and collections are kept, and every
    splat with its harmonics and further attributes. Modifiers of a point cloud are applied.

    Raises InputError, and changes nothing then: no splats of Blender's, in Edit Mode, not in the view layer, from
    another file, attributes missing, values that are not finite.
    """
    if not is_blender_splats(obj):
        raise InputError(f"'{getattr(obj, 'name', obj)}' holds no Gaussian splats; select a splat object.")
    refuse_edit_mode(obj)
    if obj.library is not None or obj.data.library is not None or obj.override_library is not None:
        raise InputError(f"'{obj.name}' is linked from another file; make it local (Object > Relations) first.")
    read_blender_cloud(obj)  # refuses before anything is changed
    if obj.type == "POINTCLOUD":
        _to_mesh(context, obj)
    cloud = read_blender_cloud(obj)
    mesh: ObjectData = obj.data
    for column in cloud.extra:
        mesh.attributes.remove(mesh.attributes[_attribute_of(mesh, column)])
    replace_cloud(obj, cloud)
    add_display(obj)
    prepare_scene(context.scene)
    return obj


def read_blender_cloud(obj: bpy.types.Object) -> SplatCloud:
    """The splats of Blender's splat object in its own space, without modifiers.

    Bands of harmonics of which some are missing are left out. Raises InputError as `make_riggable` does.
    """
    data: ObjectData = obj.data
    means = read_positions(data)
    if len(means) == 0:
        raise InputError(f"'{obj.name}' has no splats; import it again.")
    widths = {names.BASE: 4, names.ROTATION: 4, names.SCALE: 3}
    base, rotation, scale = (_wide(obj, name, width) for name, width in widths.items())
    bands: list[NDArray[Any]] = []
    while len(bands) < (MAX_SH_DEGREE + 1) ** 2 - 1:
        values = read_attribute(data, names.SH.format(len(bands)))
        if values is None or values.shape != means.shape:
            break
        bands.append(values)
    whole = int((len(bands) + 1) ** 0.5) ** 2 - 1
    sh = np.stack([base[:, :3], *bands[:whole]], axis=1)
    bad = ~np.isfinite(np.concatenate([means, rotation, scale, base, sh.reshape(len(sh), -1)], axis=1)).all(axis=1)
    if bad.any():
        raise InputError(
            f"'{obj.name}' has {int(bad.sum()):,} splats with NaN or infinite values; import the file with File > "
            "Import > Gaussian Splats and Drop Invalid Splats."
        )
    return SplatCloud(
        means=means,
        quats=normalize(rotation),
        scales=np.maximum(scale, 0.0),
        opacities=np.clip(base[:, 3], 0.0, 1.0),
        sh=sh,
        extra=_columns(data),
    )


def _wide(obj: bpy.types.Object, name: str, width: int) -> NDArray[Any]:
    values = read_attribute(obj.data, name)
    if values is None or values.shape[1:] != (width,):
        raise InputError(f"'{obj.name}' lacks the splat attribute '{name}' of {width} numbers; import it again.")
    return values


def _columns(data: ObjectData) -> dict[str, NDArray[Any]]:
    """Further single numbers of each splat by their column names."""
    found = {}
    for attribute in data.attributes:
        name = attribute.name
        own = name in _OWN or name.startswith((".", "gskin:", names.SH.format("")))
        if not own and attribute.data_type in _COLUMNS:
            values = read_attribute(data, name)
            if values is not None:
                found[name.removeprefix(names.EXTRA.format(""))] = values
    return found


def _attribute_of(data: ObjectData, column: str) -> str:
    return column if column in data.attributes else names.EXTRA.format(column)


def _to_mesh(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Blender's own Convert to Mesh, on `obj` alone; what is selected and active stays so."""
    layer = context.view_layer
    if obj.name not in layer.objects:
        raise InputError(f"'{obj.name}' is not in the view layer; switch its collection on in the outliner.")
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    active, selected, hidden = layer.objects.active, list(context.selected_objects), obj.hide_get()
    obj.hide_set(False)
    for other in selected:
        other.select_set(False)
    obj.select_set(True)
    layer.objects.active = obj
    try:
        bpy.ops.object.convert(target="MESH")
    finally:
        obj.select_set(False)
        for other in selected:
            other.select_set(True)
        layer.objects.active = active
        obj.hide_set(hidden)
    if obj.type != "MESH":
        raise InputError(f"'{obj.name}' could not be converted to a mesh; is it hidden in the viewport or excluded?")
