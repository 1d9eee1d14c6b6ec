# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job may ask for: plain values with defaults, checked before any work is done."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..files import is_plain_name
from ..guidance import DEFAULT_GUIDANCE, GUIDANCE, NO_GUIDANCE
from ..guidance.options import check_options
from ..render.backends import AUTO, BACKENDS
from ..render.camera import VIEW_COUNTS
from ..skinning.fields import WEIGHT_FIELDS
from ..skinning.fields import check_options as check_field_options
from ..skinning.initial import DEFAULT_INITIAL, INITIAL_WEIGHTS, PRESENT, needs_masks
from ..skinning.initial import check_options as check_initial_options
from ..skinning.losses import LossWeights
from ..skinning.presets import DEFAULT_PRESET, PRESETS, Preset, preset_by_name
from ..splats.cleanup import Cleanup

FRONTS = {
    "-y": (0.0, -1.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "x": (1.0, 0.0, 0.0),
}
"""The side of the object on which the front camera stands, in Blender's world."""

PRESET_FIELD = "preset"
"""Value of `field` for the weight field that the preset names."""

Check = Callable[[str, Any], None]

_LARGEST = 2**63 - 1
_DEPTH = 8


@dataclass(frozen=True)
class JobSettings:
    """Settings of job.json. What a job leaves out is as its preset says (`Preset.settings`), else as here.

    preset, guidance, init: names in their registries; max_influences: bones per splat in the result, 0 for
    no limit; seed: of all randomness; front: a key of FRONTS; views: from how many sides guidance images are taken,
    one of VIEW_COUNTS; options: the guidance provider's own;
    init_options: those of the initial weights, {"model": path} for learned ones;
    field: a name in WEIGHT_FIELDS or PRESET_FIELD; field_options: the weight field's own; mesh: name of a
    file in the job's folder with a proxy mesh in the same world space, whose vertices get the weights and carry the
    splats (see `mesh_file`), empty for none; edges_only: its vertices turn and shear as the least squares of the edges
    alone say (see `rest_rings`), while learning and afterwards, of no effect without a mesh; hygiene: what to do about
    bad splats, see `Cleanup`; losses: factors of the loss, see `LossWeights`; scope: name of a file in the job's folder
    with present weights, the splats that may change, and walls, see `core/job/scope.py`; empty for none; rasterizer: a
    name in BACKENDS, or "auto" for the fastest that works here.
    """

    preset: str = DEFAULT_PRESET
    guidance: str = DEFAULT_GUIDANCE
    init: str = DEFAULT_INITIAL
    max_influences: int = 4
    seed: int = 0
    front: str = "-y"
    views: int = 4
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    init_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    field: str = PRESET_FIELD
    field_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    mesh: str = ""
    edges_only: bool = False
    hygiene: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    losses: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    scope: str = ""
    rasterizer: str = AUTO

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> JobSettings:
        """Settings from job.json's table, which may hold anything that JSON can.

        Raises:
            InputError: an unknown name or a value that is not allowed; says which.
        """
        try:
            return cls._parse(values)
        except InputError as error:  # names and values are anybody's: the sentence stays one line
            raise InputError(_printable(str(error))) from None

    @classmethod
    def _parse(cls, values: Mapping[str, Any]) -> JobSettings:
        known = {f.name for f in dataclasses.fields(cls)}
        unknown = sorted(str(name) for name in set(values) - known)
        if unknown:
            raise InputError(
                f"The job has unknown settings {', '.join(unknown)}; known are {', '.join(sorted(known))}."
            )
        for name, value in values.items():
            _check_plain(name, value)
            CHECKS[name](name, value)
        settings = cls(**preset_by_name(values.get("preset", DEFAULT_PRESET)).completed(values))
        if settings.init == PRESENT and not settings.scope:
            raise InputError("The job's init is 'present', but it has no scope with present weights; write the scope.")
        with _naming("init_options"):
            check_initial_options(settings.init, settings.init_options)
        with _naming("field_options"):
            check_field_options(settings.field_name(preset_by_name(settings.preset)), settings.field_options)
        with _naming("hygiene"):
            Cleanup.parse(settings.hygiene)
        with _naming("options"):
            check_options(settings.guidance, settings.options)
        with _naming("losses"):
            LossWeights.parse(settings.losses)
        return settings

    def field_name(self, preset: Preset) -> str:
        """The weight field to learn with: the one named, else the preset's."""
        return preset.field if self.field == PRESET_FIELD else self.field

    @property
    def needs_runtime(self) -> bool:
        """Whether the job renders or learns, for which the worker needs more than numpy."""
        return self.guidance != NO_GUIDANCE or bool(self.mesh) or needs_masks(self.init)

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for the report."""
        return {
            name: dict(value) if isinstance(value, Mapping) else value for name, value in vars(self).items()
        }


@contextlib.contextmanager
def _naming(name: str) -> Iterator[None]:
    """What is wrong inside the block is wrong with the setting `name`, and says so."""
    try:
        yield
    except InputError as error:
        told = str(error)
        raise InputError(told if name in told else f"The job's {name}: {told[:1].lower()}{told[1:]}") from None


def _one_of(*groups: Iterable[str]) -> Check:
    """A word out of `groups`, which are looked at when a job is read."""

    def check(name: str, value: Any) -> None:
        choices = [choice for group in groups for choice in group]
        if not isinstance(value, str) or value not in choices:
            shown = f"'{value}'" if isinstance(value, str) else _shown(value)
            raise InputError(f"The job's {name} is {shown}; choose one of {', '.join(choices)}.")

    return check


def _whole(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"The job's {name} is {_shown(value)}; it must be a whole number from 0 up.")


def _switch(name: str, value: Any) -> None:
    if not isinstance(value, bool):
        raise InputError(f"The job's {name} is {_shown(value)}; it must be true or false.")


def _view_count(name: str, value: Any) -> None:
    if isinstance(value, bool) or value not in VIEW_COUNTS or not isinstance(value, int):
        counts = ", ".join(str(count) for count in VIEW_COUNTS)
        raise InputError(f"The job's {name} is {_shown(value)}; choose one of {counts}.")


def _table(name: str, value: Any) -> None:
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(f"The job's {name} are {_shown(value)}; they must be a table of names and values.")


def _own_file(name: str, value: Any) -> None:
    """A file that lies in the job's folder itself, so that a job speaks of nothing else on the disk."""
    if not isinstance(value, str) or (value and not (is_plain_name(value) and value.endswith(".npz"))):
        raise InputError(
            f"The job's {name} is {_shown(value)}; it must be the name of an .npz file in the job's own folder."
        )


CHECKS: dict[str, Check] = {
    "preset": _one_of(PRESETS),
    "guidance": _one_of(GUIDANCE),
    "init": _one_of(INITIAL_WEIGHTS, (PRESENT,)),
    "max_influences": _whole,
    "seed": _whole,
    "front": _one_of(FRONTS),
    "views": _view_count,
    "options": _table,
    "init_options": _table,
    "field": _one_of((PRESET_FIELD,), WEIGHT_FIELDS),
    "field_options": _table,
    "mesh": _own_file,
    "edges_only": _switch,
    "hygiene": _table,
    "losses": _table,
    "scope": _own_file,
    "rasterizer": _one_of((AUTO,), BACKENDS),
}
"""By the name of a setting, what its value must be on its own; raises InputError."""


def _check_plain(name: str, value: Any) -> None:
    """Raise InputError for numbers that no arithmetic here can take, and for tables in tables without end."""
    level = [value]
    for _ in range(_DEPTH):
        for item in level:
            if isinstance(item, int | float) and not -_LARGEST <= item <= _LARGEST:
                raise InputError(f"The job's {name} has a number that is too large or none; correct it.")
        tables = [item for item in level if isinstance(item, Mapping | list | tuple)]
        level = [inner for item in tables for inner in (item.values() if isinstance(item, Mapping) else item)]
        if not level:
            return
    raise InputError(f"The job's {name} has lists or tables nested more than {_DEPTH} deep; correct it.")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)
