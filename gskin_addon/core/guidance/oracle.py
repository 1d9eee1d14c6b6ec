# SPDX-License-Identifier: GPL-3.0-or-later
"""Perfect guidance from known weights, to test and measure everything after the guidance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..render.rasterizer import render_cloud
from ..rig.lbs import skin_cloud
from .control import ControlSignal
from .provider import GuidanceContext, to_bytes

SUM = 1e-2
"""How far a row may be from 1."""


class Oracle:
    """Renders the splats posed with the true weights (N, B)."""

    def __init__(self, context: GuidanceContext, weights: NDArray[np.float32]) -> None:
        self._context, self._weights = context, weights

    def images(self, signals: Sequence[ControlSignal]) -> Iterator[NDArray[np.uint8]]:
        """See Provider."""
        for signal in signals:
            posed = skin_cloud(self._context.cloud, self._weights, signal.transforms, rotate_sh=False)
            yield to_bytes(render_cloud(posed, signal.camera, self._context.background)[0])


def create(context: GuidanceContext) -> Oracle:
    """Reads the option `oracle_weights`, an .npz with `weights` (N, B) in the order of the splats and bones; where it
    names its `bones`, they are those of the armature in any order.

    Raises:
        InputError: the option or the file is missing, the shape or the bones do not fit, or they are no weights.
    """
    path = context.options.get("oracle_weights")
    if not path:
        raise InputError("The oracle guidance needs known weights; name their file in 'oracle_weights'.")
    try:
        arrays = read_arrays(Path(str(path)), ["weights"], ["bones"])
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"'{path}' does not hold an array 'weights' ({error}); write it as .npz.") from None
    weights = arrays["weights"]
    if weights.dtype.kind not in "fiub" or weights.ndim != 2:
        raise InputError(
            f"'{path}' has weights {weights.shape} of {weights.dtype}, not a table of numbers; write it again."
        )
    weights = _in_order(weights.astype(np.float32), arrays.get("bones"), context.skeleton.names, path)
    if context.index is not None and len(weights) == (context.whole or len(weights)) > int(context.index.max()):
        weights = weights[context.index]
    if weights.shape != context.initial.shape:
        raise InputError(
            f"'{path}' has weights {weights.shape}, but there are {context.initial.shape[0]} splats and "
            f"{context.initial.shape[1]} bones; make it from the same splats and armature."
        )
    # NaN is in none of the ranges.
    if not ((weights >= 0) & (weights <= 2)).all() or not (np.abs(weights.sum(axis=1) - 1) <= SUM).all():
        raise InputError(f"'{path}' has weights that are negative or not finite, or do not sum to 1; normalise them.")
    return Oracle(context, weights)


def _in_order(
    weights: NDArray[np.float32], bones: NDArray[Any] | None, wanted: Sequence[str], path: object
) -> NDArray[np.float32]:
    """The columns of weights (N, B) in the order of the bones `wanted`."""
    if bones is None:
        return weights
    names = [str(name) for name in bones.ravel()]
    if sorted(names) != sorted(wanted) or len(names) != weights.shape[1]:
        raise InputError(f"'{path}' has weights of other bones than the armature; make it from the same armature.")
    return weights[:, [names.index(name) for name in wanted]]
