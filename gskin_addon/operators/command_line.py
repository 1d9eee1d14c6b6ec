# SPDX-License-Identifier: GPL-3.0-or-later
"""`blender -b -c gskin ...`: the command line inside Blender."""

from __future__ import annotations

from typing import Any

import bpy

from ..cli import blender_command

CLASSES: tuple[type, ...] = ()
_handles: list[Any] = []


def register() -> None:
    """Give Blender the command `gskin`."""
    _handles.append(bpy.utils.register_cli_command("gskin", blender_command))


def unregister() -> None:
    """Take it back."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
