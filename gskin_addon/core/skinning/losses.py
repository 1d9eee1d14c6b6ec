# SPDX-License-Identifier: GPL-3.0-or-later
"""The factors of the loss, which a job may set. Plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ..errors import InputError

_COUNTS = {"arap_neighbours": 1, "coupling_neighbours": 1, "arap_nodes": 0}
"""Whole numbers and the least that each may be."""


@dataclass(frozen=True)
class LossWeights:
    """Factors of Eq. 9. ARAP is counted relative to the mean squared edge, coupling in the unit diagonal.

    So both are independent of the asset's scale. The paper has K_1 = 30 and does not state its w_a, w_c and K_2; these
    are the best values of a sweep (`benchmarks/sweep_losses.py`, docs/benchmarks.md).

    arap, coupling: w_a, w_c; dssim: share of D-SSIM beside L1, 0 to 1; anchor: of `PriorLoss`, named as the
    job's key; arap_neighbours, coupling_neighbours: K_1, K_2; arap_nodes: nodes drawn for ARAP in each iteration, 0
    for all.
    """

    arap: float = 0.02
    coupling: float = 10.0
    dssim: float = 0.2
    anchor: float = 0.0001
    arap_neighbours: int = 10
    coupling_neighbours: int = 8
    arap_nodes: int = 2000

    @classmethod
    def names(cls) -> list[str]:
        """Names of all factors."""
        return [f.name for f in fields(cls)]

    @classmethod
    def parse(cls, values: Mapping[str, Any]) -> LossWeights:
        """From a job's table. Raises InputError: an unknown name, or a value that is not allowed."""
        known = cls.names()
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise InputError(f"The job's losses have no option {', '.join(unknown)}; they have {', '.join(known)}.")
        for name, value in values.items():
            if name in _COUNTS:
                if isinstance(value, bool) or not isinstance(value, int) or value < _COUNTS[name]:
                    raise InputError(
                        f"The job's loss option {name} is {value!r}; use a whole number from {_COUNTS[name]} up."
                    )
            elif isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
                raise InputError(f"The job's loss option {name} is {value!r}; use a number from 0 up.")
        if values.get("dssim", 0) > 1:
            raise InputError(f"The job's loss option dssim is {values['dssim']!r}; use a number from 0 to 1.")
        return cls(**values)
