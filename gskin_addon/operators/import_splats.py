# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Gaussian Splats: .ply files become splat objects; from File > Import, the panel, or dropped on a view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.errors import GSkinError
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.ply import read_ply
from ..scene import names
from ..scene.render import prepare_scene
from ..scene.splat_object import create_splat_object


class GSKIN_OT_import_splats(bpy.types.Operator, ImportHelper):
    """Import Gaussian splats from .ply files, each as an object that an armature can deform"""

    bl_idname = "gskin.import_splats"
    bl_label = "Import Gaussian Splats (.ply)"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filename_ext = ".ply"
    if TYPE_CHECKING:
        filepath: str  # ImportHelper's
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    up: bpy.props.EnumProperty(
        name="Up",
        description="The file's axis that points up in Blender",
        items=[
            ("z", "Z", "As Blender; the file's axes are kept"),
            ("y", "Y", "As glTF and many viewers"),
            ("-y", "-Y", "As COLMAP, and so most training programs"),
        ],
        default="z",
    )
    drop_invalid: bpy.props.BoolProperty(
        name="Drop Invalid Splats",
        description="Leave out splats with NaN, infinite or zero-rotation values instead of refusing the file",
        default=False,
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """A file browser; for dropped files, which are known already, only the options."""
        return self.invoke_popup(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        paths = [Path(self.directory, file.name) for file in self.files if file.name] or [Path(self.filepath)]
        made = []
        for path in paths:
            try:
                made.append(self._import(context, path))
            except GSkinError as error:
                self.report({"ERROR"}, str(error))
        if not made:
            return {"CANCELLED"}
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj in made:
            obj.select_set(True)
        context.view_layer.objects.active = made[-1]
        prepare_scene(context.scene)
        _show_colors(context)
        return {"FINISHED"}

    def _import(self, context: bpy.types.Context, path: Path) -> bpy.types.Object:
        splats = read_ply(path, drop_invalid=self.drop_invalid)
        cloud = rotate_cloud(splats.cloud, up_rotation(self.up))
        obj = create_splat_object(cloud, path.stem, collection=context.collection)
        obj.data[names.MARK]["up"] = self.up  # for advice when an armature lies along another axis
        words = f"{path.name}: {cloud.count:,} splats, spherical harmonics of degree {cloud.sh_degree}"
        if splats.dropped:
            self.report({"WARNING"}, f"{words}; {splats.dropped:,} invalid splats left out")
        else:
            self.report({"INFO"}, words)
        return obj


class GSKIN_FH_splats(bpy.types.FileHandler):
    """Dropping .ply files on a 3D view."""

    bl_idname = "GSKIN_FH_splats"
    bl_label = "Gaussian Splats"
    bl_import_operator = GSKIN_OT_import_splats.bl_idname
    bl_file_extensions = ".ply"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def _show_colors(context: bpy.types.Context) -> None:
    """Let the 3D views of this screen show colours as captured in Solid mode, where splats would all be grey.

    A view whose colours were chosen is left alone. Lamps would shade splats a second time, and an outline would
    run around every gap between them.
    """
    for area in context.screen.areas if context.screen else ():
        space: Any
        for space in area.spaces:
            if space.type == "VIEW_3D" and space.shading.color_type == "MATERIAL":
                space.shading.color_type, space.shading.light = "VERTEX", "FLAT"
                space.shading.show_object_outline = False


def _draw_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(GSKIN_OT_import_splats.bl_idname, text="Gaussian Splats (.ply)")


CLASSES = (GSKIN_OT_import_splats, GSKIN_FH_splats)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
