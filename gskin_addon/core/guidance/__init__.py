# SPDX-License-Identifier: GPL-3.0-or-later
"""Guidance images: control signals, dynamic masks, and the providers that turn them into pictures.

Plain Python at import time, so that menus and command lines can list the providers anywhere. Adding one
is a file with a `create(context) -> Provider` and a line in `GUIDANCE`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from ..errors import InputError

if TYPE_CHECKING:
    from .provider import GuidanceContext, Provider

NO_GUIDANCE = "none"

GUIDANCE = {
    NO_GUIDANCE: "No images: the initial weights as they are, in seconds.",
    "elastic": "Built in: poses the splats as an elastic body that hangs on its bones, and renders that.",
    "flux2": "Your own FLUX.2 [klein] weights, fine-tuned or not: redraws the rest view by drawn skeletons.",
    "flux_repair": "Your own FLUX.2 [klein] weights (4B: Apache-2.0): repairs renders of the posed splats.",
    "lightning_drag": "Drags the joints with LightningDrag, the paper's diffusion model; you bring its weights.",
    "oracle": "Tests and benchmarks only: poses the splats with weights that are known to be right.",
}
DEFAULT_GUIDANCE = NO_GUIDANCE
"""Learned initial weights are better than what `elastic` makes of them; see docs/benchmarks.md."""

BENCHMARK_ONLY = frozenset({"oracle"})


def create_provider(name: str, context: GuidanceContext) -> Provider:
    """The provider called `name`, ready for `context`.

    Raises:
        InputError: there is none of that name, or it lacks something it needs.
    """
    if name not in GUIDANCE or name == NO_GUIDANCE:
        providers = ", ".join(known for known in GUIDANCE if known != NO_GUIDANCE)
        raise InputError(f"There is no guidance '{name}': choose one of {providers}.")
    provider: Provider = import_module(f".{name}", __name__).create(context)
    return provider
