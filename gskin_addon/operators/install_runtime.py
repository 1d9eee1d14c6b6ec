# SPDX-License-Identifier: GPL-3.0-or-later
"""Install the Learning Runtime: torch and what guidance needs, in an environment of its own."""

from __future__ import annotations

import sys

import bpy

from ..core.errors import GSkinError
from ..core.job.progress_text import ProgressPrinter
from ..core.worker.runtime_choice import BACKENDS, Choice, guess_backend
from ..session import learning_runtime
from ..session.preferences import runtime_folder

_TIPS = {
    "cpu": "Works everywhere; the smallest",
    "cuda": "For NVIDIA cards with a driver of 2022 or later",
    "rocm": "For AMD cards on Linux; very large",
    "apple": "For Macs with Apple's processors",
}
_ITEMS = [(name, backend.title, _TIPS[name]) for name, backend in BACKENDS.items() if sys.platform in backend.runs_on]


class GSKIN_OT_install_runtime(bpy.types.Operator):
    bl_idname = learning_runtime.INSTALL
    bl_label = "Install the Learning Runtime"
    bl_description = (
        "Fetch torch and what guidance needs into a folder of its own; nothing is installed into Blender, "
        "and what is there already is kept"
    )
    bl_options = {"INTERNAL"}

    backend: bpy.props.EnumProperty(name="Torch for", description="What computes", items=_ITEMS, default=_ITEMS[0][0])
    diffusion: bpy.props.BoolProperty(
        name="Diffusion Guidance",
        description="Also diffusers, transformers, accelerate and peft, which the guidance models that you bring need",
        default=True,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        try:
            learning_runtime.check_idle()
        except GSkinError as error:
            cls.poll_message_set(error.plain)
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Say what will be fetched and written, and ask."""
        try:
            learning_runtime.check_online(learning_runtime.chosen_source(context))
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}
        made = learning_runtime.status(context).choice
        wanted = guess_backend() if made is None else made.backend.name
        if wanted in {item[0] for item in _ITEMS}:
            self.backend = wanted
        self.diffusion = made is None or made.diffusion
        return context.window_manager.invoke_props_dialog(self, width=540, confirm_text="Install")  # type: ignore[return-value]

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "backend")
        layout.prop(self, "diffusion")
        choice = Choice(BACKENDS[self.backend], self.diffusion, learning_runtime.chosen_source(context))
        column = layout.column(align=True)
        size = f"about {choice.download / 1000:.1f} GB to fetch, {choice.disk / 1000:.1f} GB on the disk"
        column.label(text=size[:1].upper() + size[1:], icon="IMPORT")
        column.label(text=f"Packages come {choice.source.sentence}", icon="INTERNET")
        column.label(text=f"Written to {runtime_folder(context)}", icon="FILE_FOLDER")
        column.label(text="That is outside Blender's folders, so that it survives Blender's updates", icon="BLANK1")
        column = layout.column(align=True)
        column.label(text="Licences", icon="TEXT")
        for line in choice.licences:
            column.label(text=line, icon="BLANK1")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start it; in a window it goes on in the background, without one it is waited for."""
        try:
            learning_runtime.start(context, "install", self.backend, self.diffusion)
            return finish(self)
        except GSkinError as error:
            self.report({"ERROR"}, error.plain)
            return {"CANCELLED"}


def finish(operator: bpy.types.Operator) -> set[str]:
    """What comes after the start of an installation or a repair. Raises GSkinError where it is waited for and fails."""
    if bpy.app.background:
        operator.report({"INFO"}, learning_runtime.wait(ProgressPrinter("lines", sys.stdout)))
    else:
        learning_runtime.follow()
    return {"FINISHED"}


CLASSES = (GSKIN_OT_install_runtime,)


def unregister() -> None:
    learning_runtime.stop()
