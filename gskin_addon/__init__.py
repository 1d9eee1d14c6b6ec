# SPDX-License-Identifier: GPL-3.0-or-later
"""GSkin: auto-skin Gaussian splats. Importable without Blender; `register` needs bpy."""

from __future__ import annotations


def register() -> None:
    """Add gskin's operators, panels and properties to Blender."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Remove everything that `register` added."""
    from . import registration

    registration.unregister()
