# SPDX-License-Identifier: GPL-3.0-or-later
"""The default recipe: initial weights, in seconds, with nothing but numpy."""

from __future__ import annotations

from ..skinning.initial import needs_masks
from .eta import Eta, Report
from .result import SkinResult
from .steps import (
    JobInputs,
    finish_start,
    finish_weights,
    guidance_cameras,
    initial_weights,
    job_report,
    learning_subset,
    prepare_splats,
    rest_pictures,
    weight_change,
)
from .work_kinds import default_kinds


def run(job: JobInputs, report: Report) -> SkinResult:
    """Weights of all splats from their initial weights alone. Raises Cancelled where `report` does."""
    eta = Eta(report, default_kinds(job.cloud.count))
    eta.report("initial", "Preparing the splats")
    splats = prepare_splats(job)
    masks, cameras = None, []
    if needs_masks(job.settings.init):
        cameras = guidance_cameras(job, splats.cloud)
        _, masks = rest_pictures(learning_subset(job, splats, cameras).cloud, cameras)
    eta.record("splats")
    initial, confidence, start = initial_weights(job, splats, masks, cameras, eta)
    eta.record_up_to("initial", 1.0)
    eta.end_stage("initial")

    eta.report("finish", "Weights of all splats")
    weights = finish_weights(job, splats, initial.copy())
    eta.end_stage("finish")
    change = weight_change(weights, initial)
    more = {} if start is None else {"start": "bone heat"}
    return SkinResult(
        weights,
        job_report(job, splats, weights, change, confidence, eta, more),
        confidence=confidence,
        start=None if start is None else finish_start(job, splats, start),
    )
