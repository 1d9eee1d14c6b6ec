# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of the guidance models that the user brings: properties, and the consent.

The consent to fetch a model holds for this session of Blender and is stored nowhere, so that no opened file can
bring it along.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bpy

from ..core.guidance.options import (
    PROVIDER_OPTIONS,
    DiffusionOptions,
    Flux2Options,
    FluxOptions,
    KleinOptions,
    LightningDragOptions,
)

_consent = False

_OFFLOAD_TIPS = {
    "auto": "As the GPU's memory allows",
    "none": "All weights stay on the GPU; fastest",
    "model": "One model at a time is on the GPU",
    "sequential": "One layer at a time is on the GPU; slow, for small cards",
}


_KLEIN = "FLUX.2 [klein] in the diffusers layout (black-forest-labs/FLUX.2-klein-4B: Apache-2.0)"


def _is_agreed(owner: bpy.types.PropertyGroup) -> bool:
    return _consent


def _agree(owner: bpy.types.PropertyGroup, value: bool) -> None:
    global _consent
    _consent = value


def online() -> bool:
    return bpy.app.online_access


def _steps(options: type[DiffusionOptions]) -> Any:
    low, high = options.__dataclass_fields__["steps"].metadata["range"]
    return bpy.props.IntProperty(
        name="Steps",
        description="Denoising steps per image; 0: as many as the model wants",
        default=0,
        min=low,
        max=high,
    )


def _offload(options: type[DiffusionOptions]) -> Any:
    choices = options.__dataclass_fields__["offload"].metadata["choices"]
    return bpy.props.EnumProperty(
        name="Off-load",
        description="What leaves the GPU's memory while it is not needed",
        items=[(name, name.capitalize(), _OFFLOAD_TIPS[name]) for name in choices],
        default="auto",
    )


def _model(name: str, description: str) -> Any:
    return _folder(name, f"{description}: a folder, or a hub id such as owner/name")


def _folder(name: str, description: str) -> Any:
    # From 4.5 on Blender wants to be told that // is understood; before, it does not know the word.
    relative = "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties
    options: Any = {"ANIMATABLE", "PATH_SUPPORTS_BLEND_RELATIVE"} if relative else {"ANIMATABLE"}
    return bpy.props.StringProperty(name=name, description=description, subtype="DIR_PATH", options=options)


def _path(text: str) -> str:
    """A folder's path, or a hub id, as the worker is to read it: the file browser adds slashes, // is the file's."""
    text = text.strip()
    return (bpy.path.abspath(text) if text.startswith("//") else text).rstrip("/\\")


class _Options:
    """Properties with the names of a provider's options."""

    if TYPE_CHECKING:
        guidance: str
        bl_rna: Any  # every property group has it

    def as_options(self) -> dict[str, Any]:
        """Those that differ from the provider's defaults, as a job's options."""
        defaults = PROVIDER_OPTIONS[self.guidance]()
        options = {}
        for name in type(self).__annotations__:
            value, default = getattr(self, name), getattr(defaults, name)
            if self.bl_rna.properties[name].subtype == "DIR_PATH":
                value = _path(value)
            if isinstance(value, float):
                value = round(value, 5)  # a property is a 32-bit number: 0.6 reads 0.60000002
            if value != default:
                options[name] = value
        return options


def _subject() -> Any:
    return bpy.props.StringProperty(
        name="Subject",
        description="What the splats show, in a word or two, for the prompt",
        default=KleinOptions.subject,
    )


def _prompt(default: str) -> Any:
    return bpy.props.StringProperty(
        name="Prompt", description="What the model is told; {subject} stands for the subject", default=default
    )


class GSkinFlux2(_Options, bpy.types.PropertyGroup):
    guidance = "flux2"

    model: _model("Model", _KLEIN)
    lora: _folder("LoRA", "What gskin train-guidance tune --model flux2 wrote; empty: the model as it is")
    subject: _subject()
    prompt: _prompt(Flux2Options.prompt)
    steps: _steps(Flux2Options)
    offload: _offload(Flux2Options)


class GSkinFluxRepair(_Options, bpy.types.PropertyGroup):
    guidance = "flux_repair"

    model: _model("Model", _KLEIN)
    subject: _subject()
    prompt: _prompt(FluxOptions.prompt)
    strength: bpy.props.FloatProperty(
        name="Strength",
        description="How freely it repaints the posed picture inside the mask",
        default=FluxOptions.strength,
        min=0.01,
        max=1.0,
        subtype="FACTOR",
    )
    steps: _steps(FluxOptions)
    offload: _offload(FluxOptions)


class GSkinLightningDrag(_Options, bpy.types.PropertyGroup):
    guidance = "lightning_drag"

    models: _folder("Models", "A folder with one folder per model: base, vae, ip_adapter, lightning_drag, lcm_lora")
    base: _model("Base", "Inpainting model of the family of Stable Diffusion 1.5")
    vae: _model("VAE", "VAE of Stable Diffusion 1.5")
    ip_adapter: _model("IP-Adapter", "IP-Adapter with its image encoder")
    lightning_drag: _model("LightningDrag", "LightningDrag, as published or fine-tuned")
    lcm_lora: _model("LCM-LoRA", "LCM-LoRA, for the scheduler LCM")
    scheduler: bpy.props.EnumProperty(
        name="Scheduler",
        description="How the images are denoised",
        items=[
            ("lcm", "LCM", "Few steps, with the LCM-LoRA"),
            ("ddim", "DDIM", "More steps, without the LCM-LoRA"),
        ],
        default=LightningDragOptions.scheduler,
    )
    steps: _steps(LightningDragOptions)
    offload: _offload(LightningDragOptions)


class GSkinGuidance(bpy.types.PropertyGroup):
    """`scene.gskin.models`."""

    flux2: bpy.props.PointerProperty(type=GSkinFlux2)
    flux_repair: bpy.props.PointerProperty(type=GSkinFluxRepair)
    lightning_drag: bpy.props.PointerProperty(type=GSkinLightningDrag)
    allow_download: bpy.props.BoolProperty(
        name="Fetch Missing Models",
        description="Download a model named by its hub id, under its own licence, where it is not on this computer. "
        "Several gigabytes. Holds until Blender closes",
        get=_is_agreed,
        set=_agree,
    )

    def as_options(self, guidance: str) -> dict[str, Any]:
        """The job's options of a guidance; empty for those that need no model."""
        if guidance not in PROVIDER_OPTIONS:
            return {}
        return getattr(self, guidance).as_options()

    def may_download(self) -> bool:
        """Whether the person agreed to fetch what is missing, and Blender may go online at all."""
        return self.allow_download and online()


CLASSES = (GSkinFlux2, GSkinFluxRepair, GSkinLightningDrag, GSkinGuidance)


def unregister() -> None:
    _agree(None, False)
