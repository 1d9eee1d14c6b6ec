# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences."""

from __future__ import annotations

import bpy

from ..session.learning_runtime import forget
from ..session.preferences import ROOT, checks, worker_python
from .learning_runtime import draw_runtime
from .translations import tr

_SOURCES = [
    ("pytorch", "PyTorch", "torch from PyTorch's own index, the rest from pip's; $GSKIN_PACKAGE_INDEX comes first"),
    ("pip", "Pip's Settings", "Everything from the index that pip is configured for"),
    ("mirror", "Package Index", "Everything from an index of your own"),
    ("wheels", "Wheel Folder", "From a folder of .whl files, without network"),
]


def _look_anew(preferences: bpy.types.AddonPreferences, context: bpy.types.Context) -> None:
    forget()


class GSkinPreferences(bpy.types.AddonPreferences):
    bl_idname = ROOT

    python: bpy.props.StringProperty(
        name="Use this Python",
        description="A Python program of your own that computes weights: 3.11 or later with torch, numba and scipy. "
        "Empty: $GSKIN_PYTHON, the learning runtime, the active environment, or python3, whichever has torch",
        subtype="FILE_PATH",
    )
    runtime_folder: bpy.props.StringProperty(
        name="Folder",
        description="Where the learning runtime is installed; empty: a folder of yours that Blender's updates leave "
        "alone. $GSKIN_RUNTIME comes before this",
        subtype="DIR_PATH",
        update=_look_anew,
    )
    runtime_source: bpy.props.EnumProperty(
        name="Packages From", description="Where the learning runtime's packages come from", items=_SOURCES
    )
    runtime_index: bpy.props.StringProperty(
        name="Package Index", description="The address of an index, such as https://host/simple"
    )
    runtime_wheels: bpy.props.StringProperty(
        name="Wheel Folder",
        description="A folder of .whl files, filled on another computer with `pip download`",
        subtype="DIR_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        box = layout.box()
        box.label(text="Learning Runtime: torch, for guidance and optimisation")
        draw_runtime(box, context, manage=True)
        header, body = box.panel("gskin_runtime_settings", default_closed=True)
        header.label(text="Folder and Packages")
        if body is not None:
            body.use_property_split = True
            body.prop(self, "runtime_folder")
            body.prop(self, "runtime_source")
            if self.runtime_source == "mirror":
                body.prop(self, "runtime_index")
            elif self.runtime_source == "wheels":
                body.prop(self, "runtime_wheels")
        self._draw_python(context, layout)

    def _draw_python(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        """The interpreter that jobs will run in, and what is known of it."""
        row = layout.row(align=True)
        row.prop(self, "python")
        row.operator("gskin.check_python", text="Check")
        python, problem = worker_python(context)
        if python is None:
            layout.label(text=problem, icon="ERROR")
            return
        report = checks.known(python)
        if report is not None:
            layout.label(text=report.sentence, icon="CHECKMARK" if report.usable else "ERROR")
            if checks.warming(python):
                layout.label(text="Compiling for the first job, a minute, once; you may go on working", icon="TIME")
        elif checks.asking(python):
            layout.label(text=tr("Asking {python} ...").format(python=python), icon="TIME")
        else:
            layout.label(text=tr("Will use {python}").format(python=python))


CLASSES = (GSkinPreferences,)
