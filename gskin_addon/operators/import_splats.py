# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Gaussian Splats: .ply files become splat objects; from File > Import, the panel, or dropped on a view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy_extras.io_utils import ImportHelper

from ..core.errors import GSkinError
from ..core.job.up_axis import resolve_up
from ..core.rig.skeleton import Skeleton
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.cloud import SplatCloud
from ..core.splats.formats import SUFFIXES, read_splats
from ..scene import names, views
from ..scene.armature import read_skeleton
from ..scene.placement import fits_where_it_is, place_on_floor
from ..scene.render import prepare_scene
from ..scene.splat_object import create_splat_object
from ..session import readiness
from ..session.chosen import chosen_armature


class GSKIN_OT_import_splats(bpy.types.Operator, ImportHelper):
    """Import Gaussian splats from .ply files, each as an object that an armature can deform"""

    bl_idname = "gskin.import_splats"
    bl_label = "Import Gaussian Splats (.ply)"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filename_ext = ".ply"
    if TYPE_CHECKING:
        filepath: str  # ImportHelper's
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{suffix}" for suffix in SUFFIXES), options={"HIDDEN"})
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

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """A file browser; for dropped files, which are known already, only the options.

        A person wants to see what arrives; a script finds it where the file has it, unless it asks.
        """
        if not self.properties.is_property_set("place"):
            self.place = True
        if not self.properties.is_property_set("frame"):
            self.frame = not views.has_surfaces(context.scene)
        return self.invoke_popup(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        paths = [Path(self.directory, file.name) for file in self.files if file.name] or [Path(self.filepath)]
        armature = chosen_armature(context)
        made = []
        for path in paths:
            try:
                made.append(self._import(context, path, armature))
            except GSkinError as error:
                self.report({"ERROR"}, error.plain)
        if not made:
            return {"CANCELLED"}
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj in made:
            obj.select_set(True)
            readiness.look_at(obj)
        context.view_layer.objects.active = made[-1]
        prepare_scene(context.scene)
        # Attribute colours would repaint every other object, too; there the panel has a button.
        if not views.has_other_surfaces(context.view_layer):
            views.show_colors(context.screen, chosen_before=False)
        if self.frame:
            views.frame_selected(context)
        return {"FINISHED"}

    def _import(self, context: bpy.types.Context, path: Path, armature: bpy.types.Object | None) -> bpy.types.Object:
        splats = read_splats(path, drop_invalid=self.drop_invalid)
        skeleton = _skeleton(armature)
        up, assumed = resolve_up(self.up, splats.cloud, skeleton)
        cloud = rotate_cloud(splats.cloud, up_rotation(up))
        obj = create_splat_object(cloud, path.stem, collection=context.collection)
        obj.data[names.MARK]["up"] = up  # for advice when an armature lies along another axis
        words = [f"{path.name}: {cloud.count:,} splats, spherical harmonics of degree {cloud.sh_degree}"]
        if assumed:
            words.append(assumed)
        if self.place:
            within = _armature_within(context.scene, cloud)
            if within is not None:
                words.append(f"not moved, '{within.name}' lies within them")
            else:
                place_on_floor(obj)
        words += cloud.notes
        if splats.dropped:
            words.append(f"{splats.dropped:,} invalid splats left out")
        self.report({"WARNING" if splats.dropped else "INFO"}, "; ".join(words))
        return obj


class GSKIN_FH_splats(bpy.types.FileHandler):
    """Dropping .ply files on a 3D view."""

    bl_idname = "GSKIN_FH_splats"
    bl_label = "Gaussian Splats"
    bl_import_operator = GSKIN_OT_import_splats.bl_idname
    bl_file_extensions = ";".join(SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def _skeleton(armature: bpy.types.Object | None) -> Skeleton | None:
    """The bones that tell where the splats belong; None where the armature cannot tell (Auto-Skin says why)."""
    if armature is None:
        return None
    try:
        return read_skeleton(armature)
    except GSkinError:
        return None


def _armature_within(scene: bpy.types.Scene, cloud: SplatCloud) -> bpy.types.Object | None:
    """An armature of the scene that lies within the splats as they are."""
    for obj in scene.objects:
        skeleton = _skeleton(obj) if obj.type == "ARMATURE" else None
        if skeleton is not None and fits_where_it_is(cloud, skeleton):
            return obj
    return None


def _draw_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(GSKIN_OT_import_splats.bl_idname, text="Gaussian Splats (.ply)")


CLASSES = (GSKIN_OT_import_splats, GSKIN_FH_splats)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_draw_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_draw_menu)
