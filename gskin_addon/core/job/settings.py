# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job may ask for: plain values with defaults, checked before any work is done."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..guidance import DEFAULT_GUIDANCE, GUIDANCE
from ..guidance.options import check_options
from ..render.backends import AUTO, BACKENDS
from ..skinning.fields import WEIGHT_FIELDS
from ..skinning.initial import DEFAULT_INITIAL, INITIAL_WEIGHTS, PRESENT
from ..skinning.initial import check_options as check_initial_options
from ..skinning.losses import LossWeights
from ..skinning.presets import DEFAULT_PRESET, PRESETS, Preset
from ..splats.cleanup import Hygiene

FRONTS = {
    "-y": (0.0, -1.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "x": (1.0, 0.0, 0.0),
}
"""The side of the object on which the front camera stands, in Blender's world."""

PRESET_FIELD = "preset"
"""Value of `field` for the weight field that the preset names."""


@dataclass(frozen=True)
class JobSettings:
    """Settings of job.json.

    preset, guidance, init: names in their registries; max_influences: bones per splat in the result, 0 for
    no limit; seed: of all randomness; front: a key of FRONTS; options: the guidance provider's own;
    init_options: those of the initial weights, {"model": path} for learned ones;
    field: a name in WEIGHT_FIELDS or PRESET_FIELD; field_options: the weight field's own; mesh: file of a
    proxy mesh in the same world space, whose vertices get the weights and carry the splats, a path or a name in
    the job's folder; empty for none; hygiene: what to do about bad splats, see `Hygiene`; losses: factors of the
    loss, see `LossWeights`; scope: name of a file in the job's folder with present weights, the splats that may
    change, and walls, see `core/job/scope.py`; empty for none; rasterizer:
    a name in BACKENDS, or "auto" for the fastest that works here.
    """

    preset: str = DEFAULT_PRESET
    guidance: str = DEFAULT_GUIDANCE
    init: str = DEFAULT_INITIAL
    max_influences: int = 4
    seed: int = 0
    front: str = "-y"
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    init_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    field: str = PRESET_FIELD
    field_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    mesh: str = ""
    hygiene: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    losses: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scope: str = ""
    rasterizer: str = AUTO

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> JobSettings:
        """Settings from job.json's table.

        Raises:
            InputError: an unknown name or a value that is not allowed.
        """
        known = {f.name for f in dataclasses.fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise InputError(
                f"The job has unknown settings {', '.join(unknown)}; known are {', '.join(sorted(known))}."
            )
        settings = cls(**values)
        for name, choices in (
            ("preset", PRESETS),
            ("guidance", GUIDANCE),
            ("init", (*INITIAL_WEIGHTS, PRESENT)),
            ("front", FRONTS),
            ("field", (PRESET_FIELD, *WEIGHT_FIELDS)),
            ("rasterizer", (AUTO, *BACKENDS)),
        ):
            value = getattr(settings, name)
            if value not in choices:
                raise InputError(f"The job's {name} is '{value}'; choose one of {', '.join(choices)}.")
        if not isinstance(settings.init_options, Mapping):
            raise InputError(f"The job's init_options are {settings.init_options!r}; they must be a table.")
        check_initial_options(settings.init, settings.init_options)
        if not isinstance(settings.mesh, str):
            raise InputError(f"The job's mesh is {settings.mesh!r}; it must be the path of a mesh file.")
        if not isinstance(settings.scope, str):
            raise InputError(f"The job's scope is {settings.scope!r}; it must be the name of a file in its folder.")
        if settings.init == PRESENT and not settings.scope:
            raise InputError("The job's init is 'present', but it has no scope with present weights; write the scope.")
        Hygiene.parse(settings.hygiene)
        check_options(settings.guidance, settings.options)
        LossWeights.parse(settings.losses)
        for name in ("max_influences", "seed"):
            value = getattr(settings, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise InputError(f"The job's {name} is {value!r}; it must be a whole number from 0 up.")
        return settings

    def field_name(self, preset: Preset) -> str:
        """The weight field to learn with: the one named, else the preset's."""
        return preset.field if self.field == PRESET_FIELD else self.field

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for the report."""
        return {
            name: dict(value) if isinstance(value, Mapping) else value for name, value in vars(self).items()
        }
