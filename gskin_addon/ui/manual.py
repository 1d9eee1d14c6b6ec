# SPDX-License-Identifier: GPL-3.0-or-later
"""Right-click > Online Manual: which page tells about which button.

The pages are those of the address in the extension's manifest (`website`), where a release has one, else those that
lie in the extension itself. tools/build_zip.py puts both there; no address is made up here.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import bpy

PACKAGE = Path(__file__).resolve().parents[1]
CLASSES = ()

_BUTTONS = "artists/index.html"

MAPPING = (
    ("bpy.ops.gskin.import_splats*", f"{_BUTTONS}#import"),
    ("bpy.ops.gskin.export_glb*", f"{_BUTTONS}#export"),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#weights") for name in (
        "load_weights", "save_weights", "bind_to_armature", "anchor_to_mesh", "release_from_mesh",
    )),
    ("bpy.ops.gskin.transfer_weights*", f"{_BUTTONS}#weights-from-another-object"),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#after-a-job") for name in (
        "compare_weights", "pose_rig", "try_it", "test_poses", "select_unsure_splats",
    )),
    ("bpy.ops.gskin.show_moves_with*", f"{_BUTTONS}#display"),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#select") for name in (
        "select_by_bone", "select_by_color", "select_linked_splats", "grow_splat_selection", "shrink_splat_selection",
        "select_in_front", "next_unsure_cluster",
    )),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#skeleton") for name in (
        "fit_human", "fit_quadruped", "fit_bird", "mark_landmark", "clear_landmarks", "import_skeleton",
    )),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#clean-up") for name in ("select_bad_splats", "clean_splats")),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#the-check-list") for name in (
        "check_again", "enable_deform", "even_scale", "fix_rig_scale", "center_rig",
    )),
    *((f"bpy.ops.gskin.{name}*", f"{_BUTTONS}#preferences") for name in (
        "install_runtime", "repair_runtime", "cancel_runtime", "remove_runtime", "check_python",
    )),
    ("bpy.ops.gskin.job_preset_add*", f"{_BUTTONS}#settings"),
    # Whatever else the panel has: the import's line and its buttons, the job itself.
    ("bpy.ops.gskin.*", f"{_BUTTONS}#gskin-the-main-panel"),
    ("bpy.types.gskinsettings.splats*", f"{_BUTTONS}#gskin-the-main-panel"),
    ("bpy.types.gskinsettings.armature*", f"{_BUTTONS}#gskin-the-main-panel"),
    ("bpy.types.gskinsettings.proxy*", f"{_BUTTONS}#gskin-the-main-panel"),
    ("bpy.types.gskinsettings.*", f"{_BUTTONS}#settings"),
    ("bpy.types.gskinpreferences.*", f"{_BUTTONS}#preferences"),
    ("bpy.types.gskin*", f"{_BUTTONS}#settings"),
)  # fmt: skip
"""Pattern of a button, in lower case, as Blender asks for it, and the page."""


def address(package: Path = PACKAGE) -> str:
    """Where the pages are, with a slash at the end; empty where there are none, as in a source tree."""
    website = str(tomllib.loads((package / "blender_manifest.toml").read_text(encoding="utf-8")).get("website", ""))
    if website:
        return website.rstrip("/") + "/"
    pages = package / "manual"
    return pages.as_uri() + "/" if pages.is_dir() else ""


def manual_map() -> tuple[str, tuple[tuple[str, str], ...]]:
    """What `bpy.utils.register_manual_map` takes."""
    where = address()
    return where, MAPPING if where else ()


def register() -> None:
    bpy.utils.register_manual_map(manual_map)


def unregister() -> None:
    bpy.utils.unregister_manual_map(manual_map)
