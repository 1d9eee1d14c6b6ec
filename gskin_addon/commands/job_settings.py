# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a job from the options of `gskin rig`, and from NAME=VALUE pairs."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from typing import Any

from ..core.errors import InputError
from ..core.guidance import NO_GUIDANCE
from ..core.job.settings import PRESET_FIELD, JobSettings
from ..core.skinning.presets import DEFAULT_PRESET

_OF_PRESETS = ("init", "max_influences", "views")
"""Options that a preset decides where they are not given."""


def job_settings(options: argparse.Namespace, of_guidance: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that were asked for; what is left out is the preset's or the job's own default.

    of_guidance: the guidance's settings, of the types that it wants.

    Raises:
        InputError: a pair that is none, --edges-only without a mesh.
    """
    settings = {
        "preset": options.preset,
        "guidance": options.guidance,
        "field": options.field,
        "rasterizer": options.rasterizer,
        "seed": options.seed,
        "front": options.front,
        "init_options": {"model": str(options.init_model.absolute())} if options.init_model else {},
        "options": dict(of_guidance),
    }
    settings |= {name: getattr(options, name) for name in _OF_PRESETS if getattr(options, name) is not None}
    if options.loss:
        settings["losses"] = parse_options(options.loss, "--loss")
    if options.edges_only:
        if options.mesh is None:
            raise InputError("--edges-only is about a proxy mesh; name one with --mesh, or leave it out.")
        settings["edges_only"] = True
    if options.field_option:
        settings["field_options"] = parse_options(options.field_option, "--field-option")
    return settings


def warning_of_no_guidance(options: argparse.Namespace, chosen: JobSettings) -> str:
    """A sentence that names options of learning where nothing is learned; empty where all that was given counts.

    `--preset paper` alone would otherwise pass for the paper, and be its initial weights.
    """
    if chosen.guidance != NO_GUIDANCE:
        return ""
    given = {
        f"--preset {options.preset}": options.preset != DEFAULT_PRESET,
        "--views": options.views is not None,
        "--field": options.field != PRESET_FIELD,
        "--field-option": bool(options.field_option),
        "--loss": bool(options.loss),
    }
    names = [name for name, there in given.items() if there]
    if not names:
        return ""
    return (
        f"Without --guidance nothing is learned, and the initial weights ({chosen.init}) are the result; for "
        f"{', '.join(names)} to count, name one, such as --guidance elastic."
    )


def parse_options(given: list[str], option: str = "--guidance-option") -> dict[str, Any]:
    """NAME=VALUE pairs of `option` as settings; a value that is JSON (a number, true) is taken as such, else as text.

    Raises:
        InputError: a pair that is none.
    """
    values: dict[str, Any] = {}
    for pair in given:
        name, equals, text = pair.partition("=")
        if not name or not equals:
            raise InputError(f"{option} '{pair}' is not NAME=VALUE.")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text
    return values
