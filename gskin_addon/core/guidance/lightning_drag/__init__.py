# SPDX-License-Identifier: GPL-3.0-or-later
"""Guidance images by LightningDrag (Shi et al. 2024), the model that the G-Skin paper fine-tunes.

The person brings the weights, see docs/guidance.md. A checkpoint that `gskin train-guidance` wrote has the same
layout and is used in the same way. Nothing here needs torch until a provider is made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import consent
from ..control import ControlSignal
from ..diffusion import DiffusionGuidance, choose_offload, compute_device, device_memory
from ..model_files import require
from ..options import LightningDragOptions
from ..provider import GuidanceContext
from .files import find_files
from .point_maps import SPARSE, point_facts

if TYPE_CHECKING:
    from .pipeline import LightningDragPainter

RESIDENT, LARGEST = 10.0, 6.0
"""GiB of GPU memory with all models there, and with the encoders off-loaded: the 5.2 or 2.2 GiB of weights in half
precision with room for the work. Not measured on a GPU."""


class LightningDragGuidance(DiffusionGuidance):
    """The common run, which also says how many control points the model is not shown."""

    def __init__(self, context: GuidanceContext, *args: Any, most: int) -> None:
        """most: control points of an image that the model is shown, 0 for all; the rest is `DiffusionGuidance`'s."""
        super().__init__(context, *args)
        self._tick, self._most = context.tick, most
        self.facts: dict[str, Any] = {}

    def images(self, signals: Sequence[ControlSignal]) -> Iterator[NDArray[np.uint8]]:
        """See Provider; `facts` has `control_points`, see `point_facts`."""
        counts = point_facts(signals, self._most)
        self.facts = {"control_points": counts}
        if counts["dropped"]:
            self._tick(
                0.0,
                f"{counts['images_over']} of {counts['images']} images have more than {self._most} control points; "
                f"{counts['dropped']} of {counts['points']} are left out (option max_points)",
            )
        yield from super().images(signals)


def create(context: GuidanceContext) -> LightningDragGuidance:
    """The provider for `context`; its models are loaded with the first image.

    Raises:
        InputError: packages or files are missing, or the files are of another kind of model.
    """
    options = LightningDragOptions.parse(context.options, "lightning_drag")
    for package in ("torch", "diffusers", "transformers", "safetensors"):
        require(package, "The lightning_drag guidance")
    files = find_files(
        options, lambda message: context.tick(0.0, message), allow_download=consent.is_given()
    )
    tuned = files.fine_tuned()
    most = options.max_points
    if most < 0:
        most = int(tuned.get("max_points", SPARSE))

    def load() -> LightningDragPainter:
        from .pipeline import LightningDragPainter, Schedule
        from .weights import load as load_models

        device, dtype = compute_device(options.device, options.dtype)
        context.tick(0.0, "Loading LightningDrag")
        return LightningDragPainter(
            load_models(files, dtype),
            Schedule.of(options.scheduler, options.steps, options.guidance_scale),
            device=device,
            dtype=dtype,
            batch=options.batch or _batch(device_memory(device) if device.type == "cuda" else 0.0),
            max_points=most,
            offload=choose_offload(options.offload, device, RESIDENT, LARGEST) != "none",
        )

    identity = {**options.identity(), "max_points": most, "files": files.stamps()}
    return LightningDragGuidance(context, load, identity, most=most)


def _batch(memory: float) -> int:
    """Images at once for so many GiB on the GPU, one elsewhere."""
    return 1 if not memory else 2 if memory < 12 else 4 if memory < 20 else 8
