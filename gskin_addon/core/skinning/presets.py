# SPDX-License-Identifier: GPL-3.0-or-later
"""Named sets of optimisation settings. Plain data: Blender's own Python reads them for its menus."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import accumulate
from typing import Any

from ..errors import InputError
from .fields import DEFAULT_FIELD


@dataclasses.dataclass(frozen=True)
class Preset:
    """How many guidance images to make and how long to learn from them.

    stages: (image size in pixels, iterations), coarse to fine; batch: images per iteration.
    poses_per_view: guidance images for each view.
    field: a name in WEIGHT_FIELDS; learning_rate: of its logits.
    held_out: further images per view, not used for learning; the loss on them is computed at every tenth of the run,
    the best weights are kept, and `patience` checks without progress end the run (0: never).
    prune: whether a view renders only the splats that it sees.
    settings: of the job (`JobSettings`), which come with the preset where the job does not name them itself.
    """

    description: str
    poses_per_view: int
    stages: tuple[tuple[int, int], ...]
    batch: int
    learning_rate: float = 0.1
    field: str = DEFAULT_FIELD
    held_out: int = 2
    patience: int = 3
    prune: bool = True
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def iterations(self) -> int:
        """Iterations of all stages together."""
        return sum(iterations for _, iterations in self.stages)

    def completed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """A job's settings with those of the preset that they do not name; of two tables the job's entries count."""
        own = dict(self.settings)
        if values.get("field", self.field) not in (self.field, "preset"):
            own.pop("field_options", None)  # they are another field's
        for name, value in values.items():
            table = own.get(name)
            own[name] = {**table, **value} if isinstance(table, Mapping) else value
        return own

    def ranges(self) -> list[tuple[int, range]]:
        """The stages as (image size in pixels, the numbers of their iterations)."""
        ends = accumulate(iterations for _, iterations in self.stages)
        return [(size, range(end - count, end)) for (size, count), end in zip(self.stages, ends, strict=True)]


PRESETS: dict[str, Preset] = {
    "draft": Preset("A first look in well under a minute", 12, ((256, 60), (512, 40)), 4, held_out=0),
    "standard": Preset("The default: good weights in a minute or two", 24, ((256, 80), (512, 120)), 4),
    "high": Preset("More poses and longer learning", 50, ((256, 100), (512, 400)), 6),
    "thorough": Preset("As long as the paper: 500 iterations of 20 images", 50, ((512, 500),), 20),
    "paper": Preset(
        "The paper to the letter: its initial weights, its CNN volume, no anchor, no early end; half an hour or more",
        50,
        ((512, 500),),
        20,
        field="volume",
        held_out=0,
        patience=0,
        prune=False,
        settings={
            "init": "visibility",
            "max_influences": 0,
            "field_options": {"start": "fit"},
            "losses": {"anchor": 0.0, "arap_neighbours": 30, "arap_nodes": 0},
        },
    ),
}
DEFAULT_PRESET = "standard"


def preset_by_name(name: str) -> Preset:
    """The preset called `name`.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"There is no preset '{name}': choose one of {', '.join(PRESETS)}.")
    return PRESETS[name]
