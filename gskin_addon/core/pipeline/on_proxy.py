# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe for splats on a proxy mesh: the mesh's vertices get the weights and carry the splats (Eq. 4-5)."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..guidance import NO_GUIDANCE
from ..rig.lbs import sparsify
from ..skinning import subset as subsets
from .eta import Eta, Report
from .guided_stage import GuidedStage, Learned, work_kinds
from .previews import preview_images
from .proxy import Proxy
from .result import SkinResult
from .steps import (
    JobInputs,
    finish_weights,
    guidance_cameras,
    job_report,
    learning_subset,
    prepare_splats,
    rest_pictures,
    weight_change,
)


def run(job: JobInputs, report: Report) -> SkinResult:
    """Weights of the mesh's vertices, initial or learned, and of all splats from them.

    Raises:
        InputError: a mesh that cannot carry the splats; a job with a scope, which knows splats only.
        Cancelled: where `report` does.
    """
    if not job.scope.empty:
        raise InputError(
            "A job on a proxy mesh starts from nothing and changes all: leave the scope (init 'present', only, walls) "
            "or the mesh out."
        )
    guided = job.settings.guidance != NO_GUIDANCE
    eta = Eta(report, work_kinds(job, min(job.cloud.count, subsets.LIMIT)))
    stage = GuidedStage.open(job, eta)
    splats = prepare_splats(job)
    cameras = guidance_cameras(job, splats.cloud)
    subset = learning_subset(job, splats, cameras)
    proxy = Proxy.load(job.folder / job.settings.mesh, job.cloud, edges_only=job.settings.edges_only)
    eta.record("splats")
    images, masks = rest_pictures(subset.cloud, cameras)
    poser = None
    if guided:
        poser = stage.try_out_on_proxy(subset, proxy, splats.skeleton, cameras, images, masks)
    del images

    eta.report("initial", "Initial weights")
    nodes, nodes_confidence = proxy.initial(
        job.settings.init, subset.cloud, splats.skeleton, masks, cameras, job.settings.init_options
    )
    initial = proxy.to_splats(nodes)
    confidence = None
    if nodes_confidence is not None:
        confidence = proxy.to_splats(nodes_confidence[:, None], normalised=False)[:, 0]
    eta.record_up_to("initial", 1.0)
    eta.end_stage("initial")

    learned = Learned(nodes)
    if poser is not None:
        learned = stage.learn(
            subset,
            splats.skeleton,
            cameras,
            poser,
            nodes=nodes,
            initial=initial[subset.index],
            confidence=nodes_confidence,
            on_splats=lambda weights: proxy.to_splats(weights)[subset.index],
        )
    eta.report("finish", "Weights of all splats")
    weights = finish_weights(job, splats, proxy.to_splats(learned.weights))
    mesh_weights = learned.weights
    if job.settings.max_influences:
        mesh_weights = sparsify(mesh_weights, job.settings.max_influences)
    previews = preview_images(splats.cloud, initial, weights, cameras, learned.signals, learned.targets)
    eta.end_stage("finish")
    change = weight_change(weights, initial)
    if confidence is not None and guided:
        # Where the images disagree with what was known, neither is certain.
        confidence = confidence * (1 - change)
    if confidence is not None:
        confidence = np.clip(confidence, 0, 1).astype(np.float32)
    more = {**stage.report(len(subset.index) if guided else 0), **learned.report, "mesh": proxy.summary()}
    return SkinResult(
        weights, job_report(job, splats, weights, change, confidence, eta, more), previews, mesh_weights, confidence
    )
