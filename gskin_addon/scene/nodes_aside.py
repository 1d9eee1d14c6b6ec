# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats as bare points, while others export them: without node groups, and without the fabric under them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from .fabric import bring_fabrics_back, lay_fabrics_aside
from .splat_object import is_splat_object

_hidden: list[tuple[str, str]] = []
"""Names of object and modifier that are switched off meanwhile."""


def hide_nodes() -> None:
    """Switch off the Geometry Nodes modifiers of all splat objects and lay their fabrics aside, until `show_nodes`."""
    lay_fabrics_aside()
    for obj in bpy.data.objects:
        if is_splat_object(obj):
            for modifier in obj.modifiers:
                if modifier.type == "NODES" and modifier.show_viewport:
                    modifier.show_viewport = False
                    _hidden.append((obj.name, modifier.name))


def show_nodes() -> None:
    """Switch on what `hide_nodes` switched off, and bring the fabrics back."""
    bring_fabrics_back()
    if not _hidden:
        return
    present = {obj.name: obj for obj in bpy.data.objects if is_splat_object(obj)}
    while _hidden:
        object_name, modifier_name = _hidden.pop()
        obj = present.get(object_name)
        if obj is not None and modifier_name in obj.modifiers:
            obj.modifiers[modifier_name].show_viewport = True


@contextmanager
def nodes_hidden() -> Iterator[None]:
    """The splats' node groups are switched off inside the block, whatever happens."""
    hide_nodes()
    try:
        yield
    finally:
        show_nodes()
