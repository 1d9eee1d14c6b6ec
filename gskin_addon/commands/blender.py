# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether Blender is at hand."""

from __future__ import annotations

import importlib

from ..core.errors import InputError


def require_bpy() -> None:
    """Import bpy, which `scene/` needs. Raises InputError where there is none, with the remedy."""
    try:
        importlib.import_module("bpy")
    except ImportError as error:
        raise InputError(
            f"Blender's bpy module does not load ({error}); pip install 'gskin_addon[blender]', "
            "or run the same command as: blender -b -c gskin ..."
        ) from error
