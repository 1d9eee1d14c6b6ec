# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats onto a proxy mesh and off it again."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..scene.anchored import anchor_to_mesh, proxy_of, release
from ..scene.splat_object import is_splat_object
from ..session.chosen import chosen_splats, proxy_mesh


class GSKIN_OT_anchor_to_mesh(bpy.types.Operator):
    """Let the splats follow a mesh, with rotation and shear: select the splats and the mesh"""

    bl_idname = "gskin.anchor_to_mesh"
    bl_label = "Anchor Splats to Mesh"
    bl_options = {"REGISTER", "UNDO"}

    keep_residual: bpy.props.BoolProperty(
        name="Keep Distance",
        description="Leave splats beyond half a circumradius of their triangle where they are; "
        "off, they move onto that limit, as in the paper",
        default=True,
    )
    edges_only: bpy.props.BoolProperty(
        name="Edges Only",
        description="Read how the mesh deforms off its edges alone, as in the paper; off, what is scaled is scaled "
        "along its normals, too",
        default=False,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if chosen_splats(context) is None:
            cls.poll_message_set("Select a splat object; import one with File > Import > Gaussian Splats")
            return False
        if chosen_proxy(context) is None:
            cls.poll_message_set("Select the mesh along with the splats, or name it as Proxy Mesh")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        splats, proxy = chosen_splats(context), chosen_proxy(context)
        try:
            anchors = anchor_to_mesh(
                splats, proxy, keep_residual=self.keep_residual, edges_only=self.edges_only
            )
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        words = f"{anchors.count:,} splats follow '{proxy.name}'"
        beyond = int(anchors.clamped.sum())
        if beyond:
            words += f"; {beyond:,} lie beyond half a circumradius of their triangle"
        self.report({"INFO"}, words)
        return {"FINISHED"}


class GSKIN_OT_release_from_mesh(bpy.types.Operator):
    """Take the splats off the mesh that they follow"""

    bl_idname = "gskin.release_from_mesh"
    bl_label = "Release Splats from Mesh"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        splats = chosen_splats(context)
        if splats is None or proxy_of(splats) is None:
            cls.poll_message_set("Select splats that follow a mesh")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        release(chosen_splats(context))
        return {"FINISHED"}


def chosen_proxy(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active mesh that is no splat object, else the only one selected, else the panel's proxy mesh."""

    def fits(obj: bpy.types.Object | None) -> bool:
        return obj is not None and obj.type == "MESH" and not is_splat_object(obj)

    active = context.view_layer.objects.active
    if fits(active) and active.select_get():
        return active
    found = [obj for obj in context.view_layer.objects.selected if fits(obj)]
    return found[0] if len(found) == 1 else proxy_mesh(context)


CLASSES = (GSKIN_OT_anchor_to_mesh, GSKIN_OT_release_from_mesh)
