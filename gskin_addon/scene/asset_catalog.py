# SPDX-License-Identifier: GPL-3.0-or-later
"""Catalogs of Blender's asset library. Python cannot make them in Blender; they are lines of a text file.

Blender reads `blender_assets.cats.txt` of the asset library in which the .blend lies, else of the .blend's folder:
lines `id:path:simple name` after a line `VERSION 1`, empty lines, and comments that begin with #.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError
from ..core.files import write_text

FILE = "blender_assets.cats.txt"
_HEAD = """# This is an Asset Catalog Definition file for Blender.
#
# Empty lines and lines starting with `#` will be ignored.
# The first non-ignored line should be the version indicator.
# Other lines are of the format "UUID:catalog/path/for/assets:simple catalog name"

VERSION 1

"""


def ensure_catalog(folder: Path, path: str) -> str:
    """The id of the catalog of this path (`a/b` lies in `a`) in the file of a folder; made where it is not there.

    Raises InputError: a file that is not of version 1 or no text. GSkinError: it cannot be written.
    """
    path = "/".join(part.replace(":", "-").strip() for part in path.split("/"))
    file = folder / FILE
    try:
        text = file.read_text(encoding="utf-8") if file.is_file() else _HEAD
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"'{file}' cannot be read ({error}); move it away, and Blender makes it anew.") from error
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and lines[0] != "VERSION 1":
        raise InputError(f"'{file}' begins with '{lines[0][:40]}' instead of 'VERSION 1'; save it with this Blender.")
    for line in lines[1:]:
        ident, _, rest = line.partition(":")
        if rest.partition(":")[0] == path:
            return ident
    ident = str(uuid.uuid4())
    if not lines:
        text = _HEAD
    write_text(file, f"{text.rstrip()}\n{'' if lines[1:] else chr(10)}{ident}:{path}:{path.replace('/', '-')}\n")
    return ident


def catalog_folder() -> Path | None:
    """Where the present file's catalogs are; None for one that has not been saved."""
    if not bpy.data.filepath:
        return None
    place = Path(bpy.data.filepath).resolve().parent
    for library in bpy.context.preferences.filepaths.asset_libraries:
        root = Path(bpy.path.abspath(library.path)).resolve() if library.path else None
        if root is not None and (place == root or root in place.parents):
            return root
    return place


def refresh_asset_lists() -> None:
    """Let asset browsers and asset shelves that are open read their catalogs again."""
    manager = bpy.context.window_manager
    refresh: Any = bpy.ops.asset.library_refresh
    for window in manager.windows if manager is not None else ():
        for area in window.screen.areas:
            for region in area.regions:
                if region.type not in {"WINDOW", "ASSET_SHELF"}:
                    continue
                with bpy.context.temp_override(window=window, area=area, region=region):
                    if refresh.poll():
                        refresh()
