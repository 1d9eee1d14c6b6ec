# SPDX-License-Identifier: GPL-3.0-or-later
"""The kinds of work of each recipe: how many pieces of each, and guessed seconds for one, measured on two cores.

See `Eta`. Without torch, so that a window can say how long a job will take.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..guidance import NO_GUIDANCE
from ..job.settings import JobSettings
from ..skinning.fields import FIT_STEPS, RESOLUTION, WIDTH
from ..skinning.presets import Preset, preset_by_name
from ..skinning.visibility_schedule import PRUNE_FROM, visibility_schedule

Kinds = dict[str, tuple[int, float]]
"""Name -> (pieces, guessed seconds for each), in the order of the run."""

FIT = "fit"
"""The kind of a step in which a field is fitted to the initial weights (L_init)."""

IMAGES = ("first image", "guidance")
"""The kinds of making guidance images; the first one waits for what the provider must load."""

CHECKS = 10
"""Checks on the held-out poses in a run."""


def default_kinds(splats: int) -> Kinds:
    """The kinds of work of the default recipe on so many splats."""
    size = splats / 50_000
    return {"splats": (1, 0.06 * size), "initial": (1, 2.0 + 0.8 * size), "finish": (1, 0.2 * size)}


def rendering_kinds(settings: JobSettings, splats: int, bones: int) -> Kinds:
    """The kinds of work of a recipe that renders `splats` splats, with learning where there is a guidance."""
    size = splats / 50_000
    kinds = {"splats": (1, 0.06 * size), "initial": (1, 0.3 + 0.8 * size)}
    if settings.guidance != NO_GUIDANCE:
        preset = preset_by_name(settings.preset)
        field = settings.field_name(preset), settings.field_options
        kinds |= guided_kinds(preset, settings.views, splats, bones, field)
    return kinds | {"finish": (1, 0.8 * size)}


def guided_kinds(
    preset: Preset, views: int, splats: int, bones: int, field: tuple[str, Mapping[str, Any]] | None = None
) -> Kinds:
    """The kinds of work of learning from guidance images; field: name and options, the preset's if left out."""
    size = splats / 50_000
    images = views * preset.poses_per_view
    name, options = (preset.field, {}) if field is None else field
    cost = field_seconds(name, options, splats, bones)
    updates = visibility_schedule(preset, images) if splats >= PRUNE_FROM and preset.prune else ()
    wanted = images + views * preset.held_out
    first, others = IMAGES
    kinds = {"distances": (1, 0.5 * size), first: (1, 0.2 + size), others: (wanted - 1, 0.042 * (0.8 + size))}
    if options.get("start") == "fit":
        kinds[FIT] = (options.get("fit_steps", FIT_STEPS), cost)
    for size_px, stage in preset.ranges():
        pixels = (size_px / 512) ** 2
        guess = cost + preset.batch * 0.02 * (0.3 + pixels) * (0.3 + size) * (0.6 + bones / 50)
        pieces = kinds.get(learning_kind(size_px), (0, 0.0))[0] + len(stage)
        kinds[learning_kind(size_px)] = (pieces, guess)
        pieces = kinds.get(visibility_kind(size_px), (0, 0.0))[0] + sum(at in stage for at in updates)
        kinds[visibility_kind(size_px)] = (pieces, images * 0.008 * size)
    kinds["check"] = (len(checks_of(preset)) if preset.held_out else 0, views * preset.held_out * 0.02 * size)
    return kinds


def field_seconds(field: str, options: Mapping[str, Any], splats: int, bones: int) -> float:
    """Seconds that a weight field adds to an iteration, forwards, backwards and Adam. Measured for the volume, whose
    66 million parameters cost by themselves, however few splats read them; the pyramid is part of the other work."""
    if field != "volume":
        return 0.0
    fineness = options.get("resolution", RESOLUTION) / RESOLUTION
    parameters = (options.get("width", WIDTH) / WIDTH) ** 2
    readers = (0.3 + 0.7 * parameters) * fineness**2 * 0.2 * splats / 50_000 * (0.8 + bones / 100)
    return float(0.65 * parameters + readers)


def volume_memory(options: Mapping[str, Any], splats: int, bones: int) -> float:
    """GB that learning in the weight volume takes, measured: the decoder and Adam's two moments, and its features."""
    fineness = options.get("resolution", RESOLUTION) / RESOLUTION
    parameters = (options.get("width", WIDTH) / WIDTH) ** 2
    return float(0.5 + parameters + fineness**2 * splats / 50_000 * (0.15 + bones / 150))


def learning_kind(size: int) -> str:
    """The kind of an iteration on images of `size` pixels."""
    return f"learn at {size}"


def visibility_kind(size: int) -> str:
    """The kind of finding out what views of `size` pixels see."""
    return f"visibility at {size}"


def checks_of(preset: Preset) -> frozenset[int]:
    """The iterations after which the held-out poses are checked: about every tenth of the run, and the end."""
    return frozenset(round(part * preset.iterations / CHECKS) for part in range(1, CHECKS + 1))
