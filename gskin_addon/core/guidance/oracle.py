# SPDX-License-Identifier: GPL-3.0-or-later
"""Perfect guidance from known weights, to test and measure everything after the guidance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..render.rasterizer import render_cloud
from ..rig.lbs import skin_cloud
from .control import ControlSignal
from .provider import GuidanceContext, to_bytes


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
    """Reads the option `oracle_weights`, an .npz with `weights` (N, B) in the order of the splats and bones.

    Raises:
        InputError: the option or the file is missing, or the shape does not fit.
    """
    path = context.options.get("oracle_weights")
    if not path:
        raise InputError("The oracle guidance needs known weights; name their file in 'oracle_weights'.")
    try:
        weights = read_arrays(Path(str(path)), ["weights"])["weights"].astype(np.float32)
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"'{path}' does not hold an array 'weights' ({error}); write it as .npz.") from None
    if context.index is not None and len(weights) > int(context.index.max()):
        weights = weights[context.index]
    if weights.shape != context.initial.shape:
        raise InputError(
            f"'{path}' has weights {weights.shape}, but there are {context.initial.shape[0]} splats and "
            f"{context.initial.shape[1]} bones; make it from the same splats and armature."
        )
    return Oracle(context, weights)
