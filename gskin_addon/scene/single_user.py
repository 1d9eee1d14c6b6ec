# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes that several objects share, as linked duplicates do: weights and bones are in the mesh, one set for all."""

from __future__ import annotations

import bpy

from .bone_frames import armature_of


def sharers(obj: bpy.types.Object) -> list[str]:
    """Names of the other objects that have the object's mesh and follow an armature, by its weights."""
    return [
        other.name
        for other in bpy.data.objects
        if other != obj and other.data == obj.data and armature_of(other) is not None
    ]


def own_mesh(obj: bpy.types.Object) -> list[str]:
    """Give the object a mesh of its own where it shares one; gives the names of those that keep the old one."""
    others = sharers(obj)
    if others:
        obj.data = obj.data.copy()
    return others


def said_of(obj: bpy.types.Object, others: list[str]) -> str:
    """That the object got, or gets, a mesh of its own; empty where it shared none."""
    if not others:
        return ""
    names = ", ".join(f"'{name}'" for name in others[:3]) + (" and others" if len(others) > 3 else "")
    return f"'{obj.name}' has a mesh of its own now; it shared one with {names}"
