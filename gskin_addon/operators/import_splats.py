# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Gaussian Splats: files become splat objects; from File > Import, the panel, or dropped on a view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.errors import GSkinError
from ..core.splats.formats import FILE_TYPES
from ..core.splats.sog import META
from ..scene import views
from ..scene.import_file import ImportOptions, import_steps
from ..scene.render import prepare_scene
from ..scene.steps import Steps, part_of, run_for, run_to_end
from ..session import readiness
from ..session.chosen import chosen_armature
from ._ticking import begin_ticking, end_ticking

_GLOB = ";".join([*(f"*{suffix}" for suffix in FILE_TYPES), META])
_PAUSE, _SLICE = 0.01, 0.05
"""Seconds between two slices, and that a slice takes at least."""
_HARMLESS = {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE", "MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "TRACKPADPAN",
             "TRACKPADZOOM", "TIMER_REPORT", "WINDOW_DEACTIVATE"}  # fmt: skip


class GSKIN_OT_import_splats(bpy.types.Operator, ImportHelper):
    """Import files of Gaussian splats, each as an object that an armature can deform"""

    bl_idname = "gskin.import_splats"
    bl_label = "Import Gaussian Splats"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filename_ext = ".ply"
    if TYPE_CHECKING:
        filepath: str  # ImportHelper's
    filter_glob: bpy.props.StringProperty(default=_GLOB, options={"HIDDEN"})
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    up: bpy.props.EnumProperty(
        name="Up",
        description="The file's axis that points up in Blender",
        items=[
            ("auto", "Guess", "From what the splats stand on, or from the armature that lies within them"),
            ("z", "Z", "As Blender; the file's axes are kept"),
            ("y", "Y", "As glTF and many viewers"),
            ("-y", "-Y", "As COLMAP, and so most training programs"),
        ],
        default="auto",
    )
    place: bpy.props.BoolProperty(
        name="Place on Floor",
        description="Stand the splats on the floor at the world's origin, unless an armature lies within them as they "
        "are; moves the object, so that it can be undone",
        default=False,
    )
    frame: bpy.props.BoolProperty(
        name="Frame in View", description="Let the 3D views show the splats from where they look", default=False
    )
    drop_invalid: bpy.props.BoolProperty(
        name="Drop Invalid Splats",
        description="Leave out splats with NaN, infinite or zero-rotation values instead of refusing the file",
        default=False,
    )

    _asked = False
    """Whether a person chose the files, in a window."""
    _steps: Steps[None] | None = None
    _timer: bpy.types.Timer | None = None
    _said = ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """A file browser; for dropped files, which are known already, only the options.

        A person wants to see what arrives; a script finds it where the file has it, unless it asks.
        """
        self._asked = True
        if not self.properties.is_property_set("place"):
            self.place = True
        if not self.properties.is_property_set("frame"):
            self.frame = not views.has_surfaces(context.view_layer)
        return self.invoke_popup(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """At once for scripts; in a window in slices, between which Blender draws and listens."""
        self._made: list[bpy.types.Object] = []
        self._steps = self._import_all(context)
        if not self._asked or context.window is None:
            run_to_end(self._steps)
            return self._finish(context)
        return begin_ticking(self, context, _PAUSE)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Go on for a moment; Esc ends it. The view can be turned meanwhile, and nothing else be done."""
        if event.type == "ESC" and event.value == "PRESS":
            self._leave(context)
            self.report({"INFO"}, "Import cancelled.")
            return self._finish(context)
        if event.type != "TIMER":
            return {"PASS_THROUGH"} if event.type in _HARMLESS else {"RUNNING_MODAL"}
        try:
            share = run_for(self._steps, _SLICE)
        except StopIteration:
            self._leave(context)
            return self._finish(context)
        text = f"Importing splats: {share:.0%}  (Esc cancels)"
        if text != self._said and context.workspace is not None:  # each time the whole window may be drawn
            self._said = text
            context.workspace.status_text_set(text)
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender closes, or opens another file."""
        self._leave(context)

    def _leave(self, context: bpy.types.Context) -> None:
        if self._timer is None:
            return  # the file browser was closed
        self._steps.close()
        end_ticking(self, context)
        if context.workspace is not None:
            context.workspace.status_text_set(None)

    def _import_all(self, context: bpy.types.Context) -> Steps[None]:
        """One file after the other; what is wrong with one does not keep the others."""
        paths = [Path(self.directory, file.name) for file in self.files if file.name] or [Path(self.filepath)]
        options = ImportOptions(self.up, self.place, self.drop_invalid)
        armature, scene, collection = chosen_armature(context), context.scene, context.collection
        for number, path in enumerate(paths):
            steps = import_steps(path, options, armature, scene, collection)
            try:
                found = yield from part_of(steps, number / len(paths), (number + 1) / len(paths))
            except GSkinError as error:
                self.report({"ERROR"}, error.plain)
                continue
            self._made.append(found.object)
            self.report({"WARNING" if found.dropped else "INFO"}, found.words)

    def _finish(self, context: bpy.types.Context) -> set[str]:
        """Select and show what there is now."""
        if not self._made:
            return {"CANCELLED"}
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj in self._made:
            obj.select_set(True)
            readiness.look_at(obj)
        context.view_layer.objects.active = self._made[-1]
        prepare_scene(context.scene)
        # Attribute colours would repaint every other object, too; there the panel has a button.
        if not views.has_other_surfaces(context.view_layer):
            views.show_colors(context.screen, chosen_before=False)
        if self.frame:
            views.frame_selected(context)
        return {"FINISHED"}


class GSKIN_FH_splats(bpy.types.FileHandler):
    """Dropping files of splats on a 3D view."""

    bl_idname = "GSKIN_FH_splats"
    bl_label = "Gaussian Splats"
    bl_import_operator = GSKIN_OT_import_splats.bl_idname
    bl_file_extensions = ";".join(FILE_TYPES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def _draw_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(GSKIN_OT_import_splats.bl_idname, text="Gaussian Splats (.ply, .spz, .sog, ...)")


CLASSES = (GSKIN_OT_import_splats, GSKIN_FH_splats)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
