# SPDX-License-Identifier: GPL-3.0-or-later
"""Weight fields: functions of space whose parameters the optimiser learns, chosen by name.

Plain Python at import time, so that menus and command lines can list them anywhere. Adding one is a file
with a `create(points, initial, **options) -> WeightField` and a line in `WEIGHT_FIELDS`.
"""

from __future__ import annotations

from collections.abc import Mapping
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

OPTIONS: dict[str, tuple[str, ...]] = {
    "pyramid": ("resolutions",),
    "volume": ("resolution", "width", "start", "fit_steps"),
}
"""By name, the options that a field's `create` takes."""


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Raise InputError unless the field `name` has these options; what their values may be is up to the field."""
    known = OPTIONS[name]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise InputError(f"The weight field '{name}' has no option {', '.join(unknown)}; it has {', '.join(known)}.")


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
