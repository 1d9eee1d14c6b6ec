# SPDX-License-Identifier: GPL-3.0-or-later
"""Test Poses to Pose Library: what Try It plays, as pose assets to apply, blend and flip with Blender's own tools."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import GSkinError
from ..core.job.settings import FRONTS
from ..scene.asset_catalog import catalog_folder, ensure_catalog, refresh_asset_lists
from ..scene.handlers import iter_settle
from ..scene.pose_assets import clear_poses, set_preview, write_pose
from ..scene.pose_previews import iter_previews
from ..scene.steps import Steps, part_of
from ..scene.test_poses import iter_test_poses
from ..session.chosen import chosen_splats, panel_settings
from ._rig_and_splats import can_pose_splats
from ._sliced import SlicedClick


class GSKIN_OT_test_poses(SlicedClick, bpy.types.Operator):
    """Put the ends of every limb's range, as Try It plays them, into Blender's pose library: one pose for each bone and
    direction, and one for the rest pose. Done again, it replaces its own poses and leaves others alone"""

    bl_idname = "gskin.test_poses"
    bl_label = "Test Poses to Pose Library"
    bl_options = {"REGISTER", "UNDO"}

    previews: bpy.props.BoolProperty(
        name="Previews", description="Draw a small picture of the splats in each pose", default=True
    )
    catalog: bpy.props.BoolProperty(
        name="In a Catalog",
        description="Put the poses into a catalog of their own. Blender keeps catalogs in a file beside the saved "
        ".blend, blender_assets.cats.txt",
        default=True,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return can_pose_splats(cls, context)

    def work(self, context: bpy.types.Context) -> Steps[str]:
        splats = chosen_splats(context)
        front = FRONTS[panel_settings(context).front]
        yield from iter_settle(splats)
        middle = 0.3 if self.previews else 1.0
        found = yield from part_of(iter_test_poses(splats, front), 0.0, middle)
        pictures: list[Any] = []
        if self.previews:
            pictures = yield from part_of(iter_previews(splats, found.transforms, front), middle, 1.0)
        notes = []
        if found.held:
            held = ", ".join(f"'{name}'" for name in found.held[:3]) + (", ..." if len(found.held) > 3 else "")
            notes.append(f"left out, because nothing was found that turns them: {len(found.held)} bones ({held})")
        catalog, note = self._catalog(found.armature.name)
        notes += [note] if note else []
        clear_poses(found.armature)
        for number, pose in enumerate(found.poses):
            action = write_pose(found.armature, pose, catalog)
            if pictures:
                set_preview(action, pictures[number])
        refresh_asset_lists()
        return "; ".join([f"{len(found.poses)} poses are in the pose library of '{found.armature.name}'", *notes])

    def _catalog(self, name: str) -> tuple[str, str]:
        """Id of the poses' catalog and what is to be said about it; either may be empty."""
        if not self.catalog:
            return "", ""
        folder = catalog_folder()
        if folder is None:
            return "", "save the file and do it again to have them in a catalog"
        try:
            return ensure_catalog(folder, f"Test Poses/{name.replace('/', '-')}"), ""
        except GSkinError as error:
            return "", f"no catalog: {error.plain}"


CLASSES = (GSKIN_OT_test_poses,)
