# SPDX-License-Identifier: GPL-3.0-or-later
"""Probes: hidden copies of a splat object, displaced a little, under the same modifiers.

One armature's vertex groups turn splats by a formula (`rotation_nodes.py`). What else may move them (a second
armature, masks, envelopes, lattices, whatever an artist adds) is asked of the modifiers themselves: four probes, see
`probe_nodes.py`, are moved by them as the splats are, and the nodes read off where the probes are how the space around
each splat is turned and stretched. Blender evaluates them in every pose, playback and render; no Python does. Splats
that need no probes have none.

Probes are made anew whenever the splats' mesh or modifiers are others (`handlers.py`). Between them they share one
mesh, which is a copy of the splats' and not that mesh itself, so that Blender applies and joins it as ever. Animation
and drivers of the modifiers' settings are copied along.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import bpy
import numpy as np

from . import names
from .attributes import ObjectData, read_positions
from .bone_frames import has_joints
from .helpers import hide_helper
from .modifier_stack import beyond_groups, is_blind, modifiers_of
from .node_builder import get_input, has_input, input_values, set_input
from .node_groups import find_display
from .probe_nodes import CORNERS, PROBES, STEP
from .rotation_nodes import find_rotation, frames_of, probed_group, probed_steps, rotation_group
from .steps import Steps

DISTANCE = 5e-4
"""Of a probe from its splat along each axis, as a part of the extent of most splats."""
_MIDDLE = (2, 98)
"""Percentiles between which most splats are."""

_DISPLACE = "GSkin Probe"
_ASIDE = {
    "show_expanded", "is_active", "use_pin_to_last", "show_in_editmode", "show_on_cage", "show_group_selector",
    "show_manage_panel", "use_apply_on_spline",
}  # fmt: skip
"""Settings of a modifier that move nothing."""


def needs_probes(obj: bpy.types.Object) -> bool:
    """Whether the modifiers of splats, of the view or of renders, ask for more than one armature's vertex groups."""
    return bool(beyond_groups(obj, [m for m in _stack(obj) if m.show_viewport or m.show_render]))


def probes_of(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """The probes that turn the object's splats, by `CORNERS`; empty where vertex groups alone turn them."""
    modifier = find_rotation(obj)
    if modifier is None or not has_input(modifier, PROBES[0]):
        return []
    found = [get_input(modifier, label) for label in PROBES]
    return [] if None in found else found


def is_probe(obj: bpy.types.Object) -> bool:
    """Whether `obj` is such a helper, which is no object of the artist's."""
    return obj.get(names.PROBE_MARK) is not None


def has_fitting_probes(obj: bpy.types.Object) -> bool:
    """Whether the object has probes of its own, with the modifiers that it has now."""
    probes = probes_of(obj)
    if not probes or _owner(probes[0]) != obj:
        return False
    own, copied = _stack(obj), [m for m in probes[0].modifiers if not m.name.startswith(_DISPLACE)]
    return len(own) == len(copied) and all(_same(a, b) for a, b in zip(own, copied, strict=True))


def is_probed_rightly(obj: bpy.types.Object) -> bool:
    """Whether the splats have probes that fit where they need some, and none where not."""
    if _behind_display(obj):
        return False
    return has_fitting_probes(obj) if needs_probes(obj) else not probes_of(obj)


def iter_prepare_probes(obj: bpy.types.Object) -> Steps[None]:
    """Make the nodes in slices that `follow_stack` gives the splats, where it will need them."""
    frames = frames_of(obj)
    if frames is not None and needs_probes(obj):
        yield from probed_steps(bendy=has_joints(frames))


def follow_stack(obj: bpy.types.Object) -> None:
    """Let the rotation nodes follow all modifiers of the splats: with new probes where they need some, else without.

    For splats that have the nodes. Probes that nobody uses any more are `leftovers.clean`'s.
    """
    modifier, frames = find_rotation(obj), frames_of(obj)
    if modifier is None or frames is None or obj.library is not None:
        return
    put_before_display(obj)
    bendy = has_joints(frames)
    if not needs_probes(obj):
        if has_input(modifier, PROBES[0]):
            # Blender 5.2 goes on counting a user of what an input named that is there no more.
            for label in PROBES:
                set_input(modifier, label, None)
            modifier.node_group = rotation_group(bendy=bendy)
        return
    step = _step(obj)
    probes = _make(obj, step)
    modifier.node_group = probed_group(bendy=bendy)
    for label, probe in zip(PROBES, probes, strict=True):
        set_input(modifier, label, probe)
    set_input(modifier, STEP, step)


def put_before_display(obj: bpy.types.Object) -> None:
    """Blender adds an Armature modifier behind the display, where it moves nothing: it goes before it."""
    for name in _behind_display(obj):
        obj.modifiers.move(obj.modifiers.find(name), obj.modifiers.find(find_display(obj).name))


def _stack(obj: bpy.types.Object) -> list[Any]:
    return [modifier for modifier in modifiers_of(obj) if not is_blind(modifier)]


def _owner(probe: bpy.types.Object) -> bpy.types.Object | None:
    """The splat object that the probe goes with."""
    constraint: Any = next(iter(probe.constraints), None)
    return None if constraint is None else constraint.target


def _behind_display(obj: bpy.types.Object) -> list[str]:
    display = find_display(obj)
    if display is None:
        return []
    behind: list[Any] = list(obj.modifiers)[obj.modifiers.find(display.name) + 1 :]
    return [modifier.name for modifier in behind if modifier.type == "ARMATURE" and modifier.object is not None]


def _step(obj: bpy.types.Object) -> float:
    points = read_positions(obj.data)
    low, high = np.percentile(points, _MIDDLE, axis=0) if len(points) else (points, points)
    return DISTANCE * float((high - low).max(initial=0.0)) or DISTANCE


def _make(obj: bpy.types.Object, step: float) -> list[bpy.types.Object]:
    first: Any = obj.copy()
    first.name = f"GSkin Probe ({obj.name})"
    _unmark(first)
    first[names.PROBE_MARK] = True
    kept = {modifier.name for modifier in _stack(obj)}
    for modifier in [modifier for modifier in first.modifiers if modifier.name not in kept]:
        first.modifiers.remove(modifier)
    first.data = _bare_mesh(obj, first)
    first.parent = None
    for constraint in list(first.constraints):
        first.constraints.remove(constraint)
    first.constraints.new("COPY_TRANSFORMS").target = obj
    if first.asset_data is not None:
        first.asset_clear()
    hide_helper(first)
    for axis in "XYZ":
        displace = first.modifiers.new(f"{_DISPLACE} {axis}", "DISPLACE")
        displace.direction, displace.mid_level = axis, 0.0
        first.modifiers.move(len(first.modifiers) - 1, 0)
    probes = [first, *(first.copy() for _ in CORNERS[1:])]
    for probe, corner in zip(probes, CORNERS, strict=True):
        for axis, side in zip("XYZ", corner, strict=True):
            probe.modifiers[f"{_DISPLACE} {axis}"].strength = side * step
    return probes


def _bare_mesh(obj: bpy.types.Object, probe: Any) -> bpy.types.Mesh:
    """A copy of the splats' mesh that is none of splats: places and vertex groups, the rest where nodes may ask."""
    source: ObjectData = obj.data
    mesh: Any = source.copy()
    mesh.name = probe.name
    _unmark(mesh)
    mesh[names.PROBE_MARK] = True
    if not any(modifier.type == "NODES" for modifier in probe.modifiers):
        for name in [attribute.name for attribute in mesh.attributes if _is_free(attribute)]:
            mesh.attributes.remove(mesh.attributes[name])
    return mesh


def _unmark(data: Any) -> None:
    for key in [key for key in list(data.keys()) if key.startswith("gskin")]:
        del data[key]


def _is_free(attribute: Any) -> bool:
    return attribute.domain == "POINT" and not attribute.is_internal and not attribute.is_required


def _same(a: Any, b: Any) -> bool:
    return a.type == b.type and a.name == b.name and _settings(a) == _settings(b)


def _settings(modifier: Any) -> list[Any]:
    single, arrays = _moving(type(modifier).__name__)
    found = [getattr(modifier, name) for name in single] + [tuple(getattr(modifier, name)) for name in arrays]
    if modifier.type == "NODES" and modifier.node_group is not None:
        found.append(input_values(modifier))
    return found


@cache
def _moving(kind: str) -> tuple[list[str], list[str]]:
    """Names of the properties of a class of modifiers that can be set and move something: single ones and arrays."""
    found: tuple[list[str], list[str]] = [], []
    for prop in getattr(bpy.types, kind).bl_rna.properties:
        aside = prop.identifier in _ASIDE or prop.identifier.startswith("open_")
        if not (prop.is_readonly or aside or prop.type == "COLLECTION"):
            found[bool(getattr(prop, "is_array", False))].append(prop.identifier)
    return found
