# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures that the running job has written, as icons for panels.

Their pixels are given to Blender here. Where it is told a file instead, it reads that in a job of its own, and at the
end of each such job draws every region of the window again, 3D views with all their splats included.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import bpy
import bpy.utils.previews
import numpy as np

from ..core.files import read_png
from ..core.job.contract import PREVIEWS

CLASSES = ()
KINDS = (("guidance", "Guidance"), ("weights", "Weights"))
"""Name of the picture in the job folder, and what a panel calls it."""

LARGEST = 256
"""Pixels along the longer side of an icon, at most."""

_loaded: Any = None
_seen: dict[str, tuple[Path, int]] = {}


def icons(folder: Path) -> list[tuple[str, int]]:
    """(what it shows, icon) of each picture that the job in `folder` has by now. Quick: panels ask on every redraw."""
    global _loaded
    found = []
    for name, text in KINDS:
        path = folder / PREVIEWS / f"{name}.png"
        with contextlib.suppress(OSError, ValueError):  # not there yet, or just being put in place
            stamp = path, path.stat().st_mtime_ns
            if _loaded is None:
                _loaded = bpy.utils.previews.new()
            if _seen.get(name) != stamp:
                _show(name, path)
                _seen[name] = stamp
            found.append((text, _loaded[name].icon_id))
    return found


def _show(name: str, path: Path) -> None:
    """Give the icon `name` the pixels of the picture. Raises what `read_png` does."""
    pixels = read_png(path)
    step = -(-max(pixels.shape[:2]) // LARGEST)
    pixels = pixels[::-step, ::step]  # Blender's first row is the lowest
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., : pixels.shape[2]] = pixels
    icon = _loaded[name] if name in _loaded else _loaded.new(name)
    icon.image_size = rgba.shape[1], rgba.shape[0]
    icon.image_pixels.foreach_set(rgba.view(np.int32).ravel())


def forget() -> None:
    """Free the pictures."""
    global _loaded
    _seen.clear()
    if _loaded is not None:
        bpy.utils.previews.remove(_loaded)
        _loaded = None


def unregister() -> None:
    forget()
