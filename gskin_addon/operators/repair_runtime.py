# SPDX-License-Identifier: GPL-3.0-or-later
"""Repair the learning runtime: compare its files with what was installed, and fetch again what is not whole."""

from __future__ import annotations

import bpy

from ..core.errors import GSkinError
from ..session import learning_runtime
from .install_runtime import finish


class GSKIN_OT_repair_runtime(bpy.types.Operator):
    bl_idname = learning_runtime.REPAIR
    bl_label = "Repair"
    bl_description = "Compare every file with what was installed, fetch again what is not whole, and check it all"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        try:
            learning_runtime.check_idle()
        except GSkinError as error:
            cls.poll_message_set(error.plain)
            return False
        if learning_runtime.status(context).state == "missing":
            cls.poll_message_set("The learning runtime is not installed yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        made = learning_runtime.status(context).choice
        try:
            backend, diffusion = ("auto", True) if made is None else (made.backend.name, made.diffusion)
            learning_runtime.start(context, "repair", backend, diffusion)
            return finish(self)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}


CLASSES = (GSKIN_OT_repair_runtime,)
