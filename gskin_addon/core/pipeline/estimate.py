# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a job will take, said before it starts. Without torch, and quick: panels ask on every redraw."""

from __future__ import annotations

from dataclasses import replace

from ..guidance import NO_GUIDANCE
from ..job.settings import JobSettings
from ..skinning.presets import preset_by_name
from ..skinning.subset import LIMIT
from .eta import Eta
from .work_kinds import IMAGES, default_kinds, rendering_kinds, volume_memory

STARTING = 1.0
"""Seconds until the worker has loaded numpy and the job, and the weights are in the scene again."""
LOADING_TORCH = 4.0

_MEASURED = (NO_GUIDANCE, "elastic")


def estimate_seconds(settings: JobSettings, splats: int, bones: int) -> float | None:
    """Guessed seconds of a job on `splats` splats and `bones` deform bones, from its start to the written weights.

    A rough guess, from two cores; None for the guidance of diffusion models, whose images take what the GPU takes.
    """
    if settings.guidance not in _MEASURED:
        return None
    if not settings.mesh and settings.guidance == NO_GUIDANCE:
        kinds, start = default_kinds(splats), STARTING
    else:
        learned = min(splats, LIMIT)
        kinds = rendering_kinds(settings, learned, bones)
        start = STARTING + LOADING_TORCH
    return start + Eta(_silent, kinds).seconds_left()


def warning_of_time(settings: JobSettings, splats: int, bones: int) -> str:
    """A sentence on what learning in the weight volume costs, which runs on the processor whatever draws the images.

    Empty for jobs that do not learn in it.
    """
    field = settings.field_name(preset_by_name(settings.preset))
    if settings.guidance == NO_GUIDANCE or field != "volume":
        return ""
    learned = min(splats, LIMIT)
    fast = replace(settings, field="pyramid", field_options={})
    times = [in_words(_learning_seconds(chosen, learned, bones)) for chosen in (settings, fast)]
    memory = volume_memory(settings.field_options, learned, bones)
    return (
        f"Learning in the CNN weight volume takes {times[0]} and {memory:.1f} GB of memory on two processor cores; "
        f"the field 'pyramid' takes {times[1]}."
    )


def _learning_seconds(settings: JobSettings, splats: int, bones: int) -> float:
    """Guessed seconds of everything in a job but its guidance images."""
    kinds = rendering_kinds(settings, splats, bones)
    return sum(pieces * guess for name, (pieces, guess) in kinds.items() if name not in IMAGES)


def in_words(seconds: float | None) -> str:
    """About 6 s, about 25 s, about 2 min; nothing where nothing is known."""
    if seconds is None:
        return ""
    if seconds >= 90:
        return f"about {round(seconds / 60)} min"
    return f"about {max(1, round(seconds) if seconds < 20 else 5 * round(seconds / 5))} s"


def _silent(*_: object) -> None:
    return None
