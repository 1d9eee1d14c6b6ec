# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that draws splats: as Blender's own (5.3 and later, `native_nodes.py`), or as coloured ellipsoids.

Ellipsoids: in the viewport they are octahedra of one mesh, which Blender draws fast and which show their colours in
Solid mode too; in renders they are instances of a sphere whose material fades like the Gaussian itself.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from . import names
from .attributes import read_attribute
from .display_inputs import DISPLAY_INPUTS, INPUTS, LIMIT, MINIMUM_OPACITY, NATIVE, OCTAHEDRA
from .display_nodes import build_display, display_parts
from .node_builder import add_modifier, existing_group, find_group, geometry_group, get_input, has_input, set_input
from .octahedra import ensure_octahedra, octahedra_count, octahedron
from .steps import Steps, run_to_end

VERSION = 6


def display_group() -> bpy.types.NodeTree:
    """The shared node group "GSkin Display"; built once per file, in slices by `display_steps`."""
    return run_to_end(display_steps())


def display_steps() -> Steps[bpy.types.NodeTree]:
    """`display_group` in slices: its parts are groups of their own, each built in one slice."""
    parts = () if existing_group(names.DISPLAY_MODIFIER, VERSION) else display_parts()
    for number, part in enumerate(parts):
        part()
        yield (number + 1) / (len(parts) + 1)
    group, new = geometry_group(names.DISPLAY_MODIFIER, VERSION, INPUTS)
    if new:
        build_display(group)
    return group


def find_display(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The object's display modifier, by its node group and not by its name."""
    return find_group(obj, names.DISPLAY_MODIFIER)


def draws_native(obj: bpy.types.Object) -> bool:
    """Whether the object is drawn as Blender's own splats (5.3 and later)."""
    modifier = find_display(obj)
    return modifier is not None and has_input(modifier, NATIVE) and bool(get_input(modifier, NATIVE))


def add_display(obj: bpy.types.Object) -> bpy.types.NodesModifier:
    """Give the object the display modifier, last in its stack; an existing one is kept."""
    modifier = find_display(obj)
    if modifier is None:
        modifier = add_modifier(obj, names.DISPLAY_MODIFIER)
        modifier.node_group = display_group()
        # In Edit Mode the artist needs the points themselves.
        modifier.show_in_editmode = False
        match_octahedra(obj)
    obj.modifiers.move(obj.modifiers.find(modifier.name), len(obj.modifiers) - 1)
    return modifier


def renew_display(obj: bpy.types.Object) -> None:
    """Give a display of an older file the present node group; what was set stays."""
    modifier = add_display(obj)
    kept = {name: get_input(modifier, name) for name in DISPLAY_INPUTS if has_input(modifier, name)}
    modifier.node_group = display_group()
    octahedron()  # with the present material
    for name, value in kept.items():
        set_input(modifier, name, value)
    match_octahedra(obj)


def set_display(obj: bpy.types.Object, name: str, value: Any) -> None:
    """Set an input of the display by its label, one of `DISPLAY_INPUTS`, as "Display" or "Viewport Limit"."""
    set_input(add_display(obj), name, value)
    match_octahedra(obj)


def get_display(obj: bpy.types.Object, name: str) -> Any:
    """Read an input of the display; None where the object has no display modifier."""
    modifier = find_display(obj)
    return None if modifier is None else get_input(modifier, name)


def match_octahedra(obj: bpy.types.Object) -> None:
    """Give the display as many octahedra as splats are seen in the viewport; then it is drawn fast.

    Called where the settings or the splats change; nothing depends on it but speed.
    """
    modifier = find_display(obj)
    if modifier is None or not has_input(modifier, OCTAHEDRA):
        return
    seen = _count_seen(obj, get_input(modifier, LIMIT), get_input(modifier, MINIMUM_OPACITY))
    if octahedra_count(get_input(modifier, OCTAHEDRA)) != seen:
        set_input(modifier, OCTAHEDRA, ensure_octahedra(seen) if seen else None)


def _count_seen(obj: bpy.types.Object, limit: int, least: float) -> int:
    """As the nodes choose, in float32 as they do."""
    base = read_attribute(obj.data, names.BASE)
    if base is None or len(base) == 0:
        return 0
    shown = min(len(base), limit)
    splat = np.floor(np.arange(shown, dtype=np.float32) * (np.float32(len(base)) / np.float32(shown))).astype(np.int64)
    return int(np.count_nonzero(base[splat, 3] >= np.float32(least)))
