# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a job on arrays with the recipe that it needs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..guidance import NO_GUIDANCE
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from .eta import Report
from .result import SkinResult
from .steps import JobInputs


def run(
    cloud: SplatCloud, skeleton: Skeleton, settings: Mapping[str, Any], report: Report, checkpoint: Path
) -> SkinResult:
    """Skin `cloud` to `skeleton` (same world space, any unit).

    `report` is called with the progress. `checkpoint` is a folder, inside the job's, in which the optimiser leaves its
    state every few seconds; a run that finds one continues from it and ends with the same weights as an uninterrupted
    run.

    Raises:
        InputError: settings that do not exist or do not fit. Cancelled: `report` said so.
    """
    job = JobInputs.read(cloud, skeleton, settings, checkpoint)
    # Each recipe loads what it needs: the default one runs where there is numpy only.
    if job.settings.mesh:
        from . import on_proxy

        return on_proxy.run(job, report)
    if job.settings.guidance != NO_GUIDANCE:
        from . import guided

        return guided.run(job, report)
    from . import default

    return default.run(job, report)
