# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures that the running job has written, as icons for panels."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import bpy
import bpy.utils.previews

from ..core.job.contract import PREVIEWS

CLASSES = ()
KINDS = (("guidance", "Guidance"), ("weights", "Weights"))
"""Name of the picture in the job folder, and what a panel calls it."""

_loaded: Any = None
_seen: dict[str, tuple[Path, int]] = {}


def icons(folder: Path) -> list[tuple[str, int]]:
    """(what it shows, icon) of each picture that the job in `folder` has by now. Quick: panels ask on every redraw."""
    global _loaded
    found = []
    for name, text in KINDS:
        path = folder / PREVIEWS / f"{name}.png"
        with contextlib.suppress(OSError):  # not there yet, or just being put in place
            stamp = path, path.stat().st_mtime_ns
            if _loaded is None:
                _loaded = bpy.utils.previews.new()
            if _seen.get(name) != stamp:
                if name in _loaded:
                    del _loaded[name]
                # Anew, not from the thumbnails: these tell the age of a file in seconds.
                _loaded.load(name, str(path), "IMAGE", True)
                _seen[name] = stamp
            found.append((text, _loaded[name].icon_id))
    return found


def forget() -> None:
    """Free the pictures."""
    global _loaded
    _seen.clear()
    if _loaded is not None:
        bpy.utils.previews.remove(_loaded)
        _loaded = None


def unregister() -> None:
    forget()
