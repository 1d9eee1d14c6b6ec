# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's choices for Auto-Skin: `scene.gskin`."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.guidance import BENCHMARK_ONLY, DEFAULT_GUIDANCE, GUIDANCE
from ..core.job.settings import FRONTS, JobSettings
from ..core.skinning.initial import INITIAL_WEIGHTS
from ..core.skinning.presets import DEFAULT_PRESET, PRESETS
from .chosen import is_any_splats, is_armature, is_proxy
from .guidance_settings import GSkinGuidance

_INITIAL_TIPS = {
    "learned": "By a small network that has seen how artists weight bodies; comes with the add-on",
    "visibility": "Straight distance to the bones, farther where the splat cannot see the bone (the paper's)",
    "geodesic": "Distance through the inside of the body; better where limbs come close to each other",
    "heat": "Blender's bone heat, on the splats themselves: bones behind a splat count as nearer than those before it",
}
_PRESETS = [(name, name.capitalize(), preset.description) for name, preset in PRESETS.items()]
_GUIDANCE = [
    (name, name.replace("_", " ").title(), tip) for name, tip in GUIDANCE.items() if name not in BENCHMARK_ONLY
]
_INITIAL = [(name, name.capitalize(), _INITIAL_TIPS.get(name, "")) for name in INITIAL_WEIGHTS]
_FRONTS = [(name, name.upper(), "") for name in FRONTS]
_DEFAULTS = JobSettings()
_BROUGHT = ("init", "max_influences")
"""Choices of the panel that some preset sets (`Preset.settings`)."""


def _take_over(settings: GSkinSettings, context: bpy.types.Context) -> None:
    """Another preset: show the choices that it brings along, which may be changed, and take back those of the last."""
    for name in _BROUGHT:
        was, brought = (getattr(settings, f"{name}_{when}") for when in ("before", "brought"))
        if brought != was and getattr(settings, name) == brought:
            setattr(settings, name, was)
        now = getattr(settings, name)
        new = PRESETS[settings.preset].settings.get(name, now)
        setattr(settings, f"{name}_before", now)
        setattr(settings, f"{name}_brought", new)
        if new != now:
            setattr(settings, name, new)


class GSkinSettings(bpy.types.PropertyGroup):
    splats: bpy.props.PointerProperty(
        name="Splats",
        description="The splat object to skin; empty: the selected one",
        type=bpy.types.Object,
        poll=is_any_splats,
    )
    armature: bpy.props.PointerProperty(
        name="Armature",
        description="The armature whose deform bones get the weights; empty: the selected one",
        type=bpy.types.Object,
        poll=is_armature,
    )
    proxy: bpy.props.PointerProperty(
        name="Proxy Mesh",
        description="A mesh of the same object: weights are learned on it, and the splats follow it with rotation "
        "and shear; empty: each splat has its own weights",
        type=bpy.types.Object,
        poll=is_proxy,
    )
    edges_only: bpy.props.BoolProperty(
        name="Edges Only",
        description="Read how the mesh deforms off its edges alone, as in the paper; off, what is scaled is scaled "
        "along its normals, too",
        default=False,
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        description="How much guidance is made and how long is learned from it",
        items=_PRESETS,
        default=DEFAULT_PRESET,
        update=_take_over,
    )
    guidance: bpy.props.EnumProperty(
        name="Guidance",
        description="What shows the optimisation how the posed splats should look",
        items=_GUIDANCE,
        default=DEFAULT_GUIDANCE,
    )
    models: bpy.props.PointerProperty(type=GSkinGuidance)
    init: bpy.props.EnumProperty(
        name="Initial Weights",
        description="What the optimisation starts from",
        items=_INITIAL,
        default=_DEFAULTS.init,
    )
    front: bpy.props.EnumProperty(
        name="Front",
        description="The side to which the character looks; the guidance's cameras stand around it",
        items=_FRONTS,
        default=_DEFAULTS.front,
    )
    paintable: bpy.props.BoolProperty(
        name="Make Paintable",
        description="Lay a fabric under the splats, on which Blender's brushes and weight tools work. It is seen in "
        "Weight Paint and Edit Mode only, never rendered or exported; the file grows by some 60 bytes a splat",
        default=True,
    )
    max_influences: bpy.props.IntProperty(
        name="Max Influences",
        description="The most bones that move one splat; game engines and glTF viewers expect 4. 0: no limit",
        default=_DEFAULTS.max_influences,
        min=0,
        max=4,
    )
    # What the preset found and what it set; equal where it set nothing.
    init_before: bpy.props.StringProperty(default=_DEFAULTS.init, options={"HIDDEN"})
    init_brought: bpy.props.StringProperty(default=_DEFAULTS.init, options={"HIDDEN"})
    max_influences_before: bpy.props.IntProperty(default=_DEFAULTS.max_influences, options={"HIDDEN"})
    max_influences_brought: bpy.props.IntProperty(default=_DEFAULTS.max_influences, options={"HIDDEN"})
    seed: bpy.props.IntProperty(
        name="Seed",
        description="Choice of random poses; the same seed gives the same weights",
        default=0,
        min=0,
    )

    def needs_runtime(self) -> bool:
        """Whether these choices need a Python with torch."""
        chosen = JobSettings(guidance=self.guidance, init=self.init)
        return chosen.needs_runtime or (self.proxy is not None and is_proxy(self, self.proxy))

    def as_job(self) -> dict[str, Any]:
        """The choices as settings of a job."""
        names = ("preset", "guidance", "init", "front", "max_influences", "seed")
        options = self.models.as_options(self.guidance)
        job = {name: getattr(self, name) for name in names}
        if self.proxy is not None and self.edges_only:
            job["edges_only"] = True
        return {**job, "options": options} if options else job


CLASSES = (GSkinSettings,)


def register() -> None:
    scenes: Any = bpy.types.Scene
    scenes.gskin = bpy.props.PointerProperty(type=GSkinSettings)


def unregister() -> None:
    scenes: Any = bpy.types.Scene
    del scenes.gskin
