# SPDX-License-Identifier: GPL-3.0-or-later
"""How the settings of a guidance model are drawn."""

from __future__ import annotations

import bpy

from ..core.guidance.model_files import is_hub_id
from ..core.guidance.options import PROVIDER_OPTIONS
from ..session import guidance_settings


def draw(layout: bpy.types.UILayout, models: bpy.types.PropertyGroup, guidance: str) -> None:
    """The settings of `guidance` and, where a model may have to be fetched, the consent."""
    if guidance not in PROVIDER_OPTIONS:
        return
    chosen = getattr(models, guidance)
    box = layout.box()
    _DRAW[guidance](chosen, box)
    named = PROVIDER_OPTIONS[guidance].parse(chosen.as_options(), guidance).models_named()
    if any(is_hub_id(name) for name in named.values()):
        if guidance_settings.online():
            box.prop(models, "allow_download")
        else:
            box.label(text="Online access is off in the preferences", icon="INTERNET_OFFLINE")


def _draw_klein(settings: bpy.types.PropertyGroup, layout: bpy.types.UILayout) -> None:
    """The settings of what runs FLUX.2 [klein]."""
    for name in ("model", "lora", "subject", "prompt", "strength", "steps", "offload"):
        if hasattr(settings, name):
            layout.prop(settings, name, icon="FILE_FOLDER" if name in {"model", "lora"} else "NONE")


def _draw_lightning_drag(settings: guidance_settings.GSkinLightningDrag, layout: bpy.types.UILayout) -> None:
    """Add the settings to `layout`."""
    layout.prop(settings, "models")
    header, body = layout.panel("gskin_lightning_drag_models", default_closed=True)
    header.label(text="Models Elsewhere")
    if body is not None:
        for name in ("base", "vae", "ip_adapter", "lightning_drag", "lcm_lora"):
            if name != "lcm_lora" or settings.scheduler == "lcm":
                body.prop(settings, name)
    for name in ("scheduler", "steps", "offload"):
        layout.prop(settings, name)


_DRAW = {"flux2": _draw_klein, "flux_repair": _draw_klein, "lightning_drag": _draw_lightning_drag}
