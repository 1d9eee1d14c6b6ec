# SPDX-License-Identifier: GPL-3.0-or-later
"""Cancel the installation of the learning runtime."""

from __future__ import annotations

import bpy

from ..session import learning_runtime


class GSKIN_OT_cancel_runtime(bpy.types.Operator):
    """Stop the installation; what is fetched and installed stays, and installing again goes on from there"""

    bl_idname = "gskin.cancel_runtime"
    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return learning_runtime.state.client is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        learning_runtime.cancel()
        return {"FINISHED"}


CLASSES = (GSKIN_OT_cancel_runtime,)
