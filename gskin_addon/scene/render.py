# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings with which Blender's renderers show splats right, and a still picture for the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from .native_nodes import has_native_splats

TRANSPARENT_BOUNCES = 256
"""Splats that a ray may pass in Cycles; Blender's default of 8 turns dense splats dark."""

CERTAIN_BOUNCES = 64
"""Splats that every ray passes. With Blender's 0 Cycles ends rays by lot and makes up for it in those that go on: white
flecks on dark splats. On a captured face more than 64 gains 0.01 dB."""

VIEW_SAMPLES = 32
"""Samples of a Rendered view at which Blender's own splats, which it dithers, are 32 dB near; it has 16."""


def prepare_scene(scene: bpy.types.Scene) -> None:
    """Raise the scene's transparency depth, and where Blender draws splats itself the samples of its views, to what
    splats need; nothing else changes."""
    eevee = getattr(scene, "eevee", None)
    # 0 samples are as many as there is time for.
    if has_native_splats() and eevee is not None and 0 < eevee.taa_samples < VIEW_SAMPLES:
        eevee.taa_samples = VIEW_SAMPLES
    cycles = getattr(scene, "cycles", None)
    if cycles is not None:
        cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)


def has_flecks(scene: bpy.types.Scene) -> bool:
    """Whether Cycles renders the scene and would end rays among splats by lot."""
    cycles, engine = getattr(scene, "cycles", None), str(scene.render.engine)
    return engine == "CYCLES" and cycles is not None and cycles.min_transparent_bounces < CERTAIN_BOUNCES


def clear_flecks(scene: bpy.types.Scene) -> None:
    """Raise what Cycles needs for splats without flecks; nothing else changes."""
    prepare_scene(scene)
    scene.cycles.min_transparent_bounces = max(scene.cycles.min_transparent_bounces, CERTAIN_BOUNCES)


def changes_colors(scene: bpy.types.Scene) -> bool:
    """Whether the scene's view transform or look changes captured colours in renders and rendered views."""
    view: Any = scene.view_settings
    return view.view_transform not in {"Standard", "Raw"} or view.look != "None"


def use_standard_view(scene: bpy.types.Scene) -> None:
    """Show colours as they are: view transform Standard, no look."""
    view: Any = scene.view_settings
    view.view_transform, view.look = "Standard", "None"


def render_still(scene: bpy.types.Scene, path: Path, *, size: tuple[int, int] = (512, 512), samples: int = 32) -> None:
    """Render the scene's camera to a PNG with Cycles on the CPU, colours as captured (no tone curve).

    size: (width, height) in pixels. The scene's own settings are put back afterwards.
    """
    clear_flecks(scene)
    render, view, cycles = scene.render, scene.view_settings, scene.cycles
    wanted = [
        (render, "engine", "CYCLES"),
        (render, "resolution_x", size[0]),
        (render, "resolution_y", size[1]),
        (render, "resolution_percentage", 100),
        (render, "filepath", str(path)),
        (render.image_settings, "file_format", "PNG"),
        (view, "view_transform", "Standard"),
        (view, "look", "None"),
        (cycles, "device", "CPU"),
        (cycles, "samples", samples),
        (cycles, "use_denoising", False),
    ]
    before = [(owner, key, getattr(owner, key)) for owner, key, _ in wanted]
    try:
        for owner, key, value in wanted:
            setattr(owner, key, value)
        bpy.ops.render.render(write_still=True, scene=scene.name)
    finally:
        for owner, key, value in reversed(before):
            setattr(owner, key, value)
