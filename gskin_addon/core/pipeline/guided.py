# SPDX-License-Identifier: GPL-3.0-or-later
"""The guided recipe: weights of a subset are learned from guidance images and carried over to all splats."""

from __future__ import annotations

import numpy as np

from ..rig.influences import Influences
from ..skinning import subset as subsets
from .eta import Eta, Report
from .guided_stage import GuidedStage, work_kinds
from .previews import preview_images
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


def run(job: JobInputs, report: Report) -> SkinResult:
    """Weights of all splats, learned from the guidance's images. Raises Cancelled where `report` does."""
    eta = Eta(report, work_kinds(job, min(job.cloud.count, subsets.LIMIT)))
    stage = GuidedStage.open(job, eta)
    splats = prepare_splats(job)
    cameras = guidance_cameras(job, splats.cloud)
    subset = learning_subset(job, splats, cameras)
    eta.record("splats")
    images, masks = rest_pictures(subset.cloud, cameras)
    poser = stage.try_out_on_splats(subset, splats.skeleton, cameras, images, masks)
    del images

    initial, confidence, _ = initial_weights(job, splats, masks, cameras, eta)
    eta.record_up_to("initial", 1.0)
    eta.end_stage("initial")
    nodes = initial[subset.index]
    learned = stage.learn(
        subset,
        splats.skeleton,
        cameras,
        poser,
        nodes=nodes,
        initial=nodes,
        confidence=None if confidence is None else confidence[subset.index],
        movable=None if job.scope.only is None else job.scope.movable(job.cloud.count)[subset.index],
    )

    eta.report("finish", "Weights of all splats")
    weights = subset.to_all_splats(learned.weights, nodes, initial, learned.query)
    weights = finish_weights(job, splats, weights)
    previews = preview_images(splats.cloud, initial, weights, cameras, learned.signals, learned.targets)
    eta.end_stage("finish")
    change = weight_change(weights, initial)
    if confidence is not None:
        # Where the images disagree with what was known, neither is certain.
        confidence = np.clip(confidence * (1 - change), 0, 1).astype(np.float32)
    more = {**stage.report(len(subset.index)), **learned.report, "start": f"initial weights ({job.settings.init})"}
    return SkinResult(
        weights,
        job_report(job, splats, weights, change, confidence, eta, more),
        previews,
        confidence=confidence,
        start=finish_start(job, splats, Influences.strongest(initial)),
    )
