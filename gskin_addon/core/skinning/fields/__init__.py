# SPDX-License-Identifier: GPL-3.0-or-later
"""Weight fields: functions of space whose parameters the optimiser learns, chosen by name.

Plain Python at import time, so that menus and command lines can list them anywhere. Adding one is a file
with a `create(points, initial, **options) -> WeightField` and a line in `WEIGHT_FIELDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from ...errors import InputError

if TYPE_CHECKING:
    from .base import WeightField

WEIGHT_FIELDS = {
    "pyramid": "Residual logits on sparse voxel grids of several sizes: fast and light",
    "volume": "The paper's CNN volume: a 128^3 volume of logits, decoded from 256 numbers",
}
DEFAULT_FIELD = "pyramid"

LOG_FLOOR = 1e-4
"""Least initial weight. Eq. (7) gives far bones about 1e-6; their logits must stay within reach of Adam."""

RESOLUTION = 128
"""Voxels along each axis of the weight volume, the paper's value."""

WIDTH = 1024
"""Channels of the first voxel of its decoder, the paper's value."""

FINEST, WIDEST = 1024, 4096
"""Bounds of a pyramid's resolutions and of a volume's width: more would fill any memory."""

_VOLUMES = (4, 8, 16, 32, 64, 128, 256)

FIT_STEPS = 500
"""The most steps in which a volume is fitted to the initial weights."""

OPTIONS: dict[str, tuple[str, ...]] = {
    "pyramid": ("resolutions",),
    "volume": ("resolution", "width", "start", "fit_steps"),
}
"""By name, the options that a field's `create` takes."""


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Raise InputError unless the field `name` has these options and their values can be used."""
    known = OPTIONS[name]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise InputError(f"The weight field '{name}' has no option {', '.join(unknown)}; it has {', '.join(known)}.")
    for option, value in options.items():
        wrong = _WRONG[option](value)
        if wrong:
            raise InputError(f"{wrong[0]} {value!r}; {wrong[1]}.")


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _wrong_resolutions(value: Any) -> tuple[str, str] | None:
    sizes = value if isinstance(value, list | tuple) else ()
    if sizes and all(_whole(size) and 2 <= size <= FINEST for size in sizes):
        return None
    return "The pyramid's resolutions are", f"they must be whole numbers from 2 to {FINEST}, as [8, 16, 32]"


def _wrong_resolution(value: Any) -> tuple[str, str] | None:
    if _whole(value) and value in _VOLUMES:
        return None
    return "The weight volume's resolution is", "it must be a power of 2 from 4 to 256"


def _wrong_width(value: Any) -> tuple[str, str] | None:
    if _whole(value) and 8 <= value <= WIDEST:
        return None
    return "The weight volume's width is", f"it must be a whole number from 8 to {WIDEST}"


def _wrong_start(value: Any) -> tuple[str, str] | None:
    if isinstance(value, str) and value in ("prior", "fit"):
        return None
    return "The weight volume's start is", "choose prior or fit"


def _wrong_fit_steps(value: Any) -> tuple[str, str] | None:
    if _whole(value) and value >= 1:
        return None
    return "The weight volume's fit_steps is", "it must be a whole number from 1 up"


_WRONG: dict[str, Callable[[Any], tuple[str, str] | None]] = {
    "resolutions": _wrong_resolutions,
    "resolution": _wrong_resolution,
    "width": _wrong_width,
    "start": _wrong_start,
    "fit_steps": _wrong_fit_steps,
}
"""By option, what is wrong with a value: the beginning of the sentence and the remedy."""


def create_field(
    name: str, points: NDArray[Any], initial: NDArray[Any], options: Mapping[str, Any] | None = None
) -> WeightField:
    """The field called `name` on the splat centres `points` (N, 3), at the weights `initial` (N, B).

    Raises:
        InputError: there is no field of that name, or it has no such option.
    """
    if name not in WEIGHT_FIELDS:
        raise InputError(f"There is no weight field '{name}': choose one of {', '.join(WEIGHT_FIELDS)}.")
    check_options(name, options or {})
    create = import_module(f".{name}", __name__).create
    field: WeightField = create(points, initial, **(options or {}))
    return field
