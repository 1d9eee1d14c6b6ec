# SPDX-License-Identifier: GPL-3.0-or-later
"""GSkin: auto-skin Gaussian splats. Importable without Blender; `register` needs bpy."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """The class that Blender's glTF exporter looks for in add-ons; loaded on demand, for it needs bpy."""
    if name == "glTF2ExportUserExtension":
        from .scene.gltf_export import SplatExport

        return SplatExport
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def register() -> None:
    """Add gskin's operators, panels and properties to Blender."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Remove everything that `register` added."""
    from . import registration

    registration.unregister()
