# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps that the recipes share, from a job's arrays to its weights. numpy only at import time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..job.scope import Scope, read_scope
from ..job.settings import FRONTS, JobSettings
from ..render.backends import AUTO, resolve_backend
from ..render.camera import PAPER_AZIMUTHS, Camera, evaluation_views, paper_views, percentile_bounds
from ..rig.influences import Influences
from ..rig.lbs import sparsify
from ..rig.skeleton import Skeleton
from ..skinning.edits.keep_apart import keep_apart
from ..skinning.extent import unit_frame
from ..skinning.initial import PRESENT, initial_with_start
from ..skinning.subset import SplatSubset, follow_nearest
from ..splats.cleanup import Cleanup
from ..splats.cloud import SplatCloud
from .eta import Eta

GUIDANCE_SIZE = 512
"""Width and height of guidance images, pixels."""
_ROWS = 50_000

Weights = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class JobInputs:
    """The inputs of a recipe.

    settings: checked; cloud, skeleton: in the world space of the job, any unit; folder: the job's, where files that
    its settings name lie; checkpoint: a folder inside it for what a stopped run needs to go on.
    """

    settings: JobSettings
    cloud: SplatCloud
    skeleton: Skeleton
    folder: Path
    checkpoint: Path
    scope: Scope

    @classmethod
    def read(cls, cloud: SplatCloud, skeleton: Skeleton, settings: Mapping[str, Any], checkpoint: Path) -> JobInputs:
        """Check the settings and read the files that they name.

        Raises:
            InputError: settings that do not exist or do not fit, files that are missing or damaged.
        """
        chosen = JobSettings.parse(settings)
        folder = checkpoint.parent
        if chosen.rasterizer != AUTO:
            resolve_backend(chosen.rasterizer)  # refused before any work
        scope = Scope()
        if chosen.scope:
            scope = read_scope(folder / chosen.scope, cloud.count, skeleton.count).filled(cloud.means)
        if chosen.init == PRESENT and scope.present is None:
            raise InputError(
                f"'{folder / chosen.scope}' has no present weights to start from; add them, or choose an init."
            )
        return cls(chosen, cloud, skeleton, folder, checkpoint, scope)


@dataclass(frozen=True, eq=False)
class PreparedSplats:
    """Splats and skeleton in unit size (bounding box of diagonal 1 around 0), and what is wrong with some of them.

    shaped: the same splats with needles widened, for rendering; ignored (N,): strays and faint giants, which take no
    part in learning; counts: of each fault, for the report.
    """

    cloud: SplatCloud
    shaped: SplatCloud
    skeleton: Skeleton
    ignored: NDArray[np.bool_]
    counts: dict[str, int]


def prepare_splats(job: JobInputs) -> PreparedSplats:
    """Bring a job to unit size and find its bad splats."""
    cloud, skeleton = to_unit_size(job.cloud, job.skeleton)
    cleanup = Cleanup.parse(job.settings.hygiene)
    ignored, bad = cleanup.find(cloud)
    shaped, needles = cleanup.shape(cloud)
    return PreparedSplats(cloud, shaped, skeleton, ignored, {**bad, **needles})


def to_unit_size(cloud: SplatCloud, skeleton: Skeleton) -> tuple[SplatCloud, Skeleton]:
    """Both moved and scaled so that the object's bounding box has the diagonal 1 and its centre at 0."""
    centre, diagonal = unit_frame(cloud.means)
    moved = replace(
        cloud,
        means=((cloud.means - centre) / diagonal).astype(np.float32),
        scales=(cloud.scales / diagonal).astype(np.float32),
        stored={},
    )
    return moved, skeleton.moved(np.eye(3), 1.0 / diagonal, -centre / diagonal)


def guidance_cameras(job: JobInputs, cloud: SplatCloud) -> list[Camera]:
    """The paper's four views around splats in unit size, and two more where the job asks for six.

    Masks are taken from all of them, guidance images from the first `views` (`JobSettings`).
    """
    around = evaluation_views if job.settings.views > len(PAPER_AZIMUTHS) else paper_views
    return around(*percentile_bounds(cloud.means), GUIDANCE_SIZE, front=FRONTS[job.settings.front])


def rest_pictures(
    cloud: SplatCloud, cameras: Sequence[Camera]
) -> tuple[list[NDArray[Any]], NDArray[np.bool_]]:
    """Images (H, W, 3) in [0, 1] of the splats at rest, and masks (V, H, W) of where they are."""
    from ..render.rasterizer import render_cloud

    pictures = [render_cloud(cloud, camera) for camera in cameras]
    return [image for image, _ in pictures], np.stack([alpha > 0.5 for _, alpha in pictures])


def learning_subset(job: JobInputs, splats: PreparedSplats, cameras: Sequence[Camera]) -> SplatSubset:
    """The splats that represent all of them in renders."""
    from ..skinning.subset import choose_subset

    def visible() -> NDArray[np.bool_]:
        return _seen_at_rest(splats.shaped, cameras)

    return choose_subset(splats.shaped, job.settings.seed, ignored=splats.ignored, visible=visible)


def initial_weights(
    job: JobInputs,
    splats: PreparedSplats,
    masks: NDArray[np.bool_] | None,
    cameras: Sequence[Camera],
    eta: Eta,
) -> tuple[Weights, NDArray[np.float32] | None, Influences | None]:
    """Initial weights (N, B) of all splats, their confidence (N,), where the method knows it, and what the method
    itself started from, where it has learned.

    masks (V, H, W): of the object in each camera; for methods that need them (`needs_masks`). Splats that the job may
    not change keep their present weights.
    """
    eta.report("initial", "Initial weights")
    if job.settings.init == PRESENT:
        if job.scope.present is None:
            raise ValueError("JobInputs.read refuses this")
        return job.scope.present.copy(), None, None

    def tick(fraction: float) -> None:
        eta.record_up_to("initial", fraction)
        eta.report("initial", "Initial weights")

    weights, confidence, start = initial_with_start(
        job.settings.init,
        splats.cloud,
        splats.skeleton,
        masks,
        cameras,
        job.settings.init_options,
        walls=job.scope.walls,
        tick=tick,
    )
    return keep_present(job.scope, _apart(job, splats, weights)), confidence, start


def keep_present(scope: Scope, weights: Weights) -> Weights:
    """`weights` (N, B), changed in place, with the present ones of all splats that may not change, to the bit."""
    if scope.only is not None and scope.present is not None:
        still = ~scope.movable(len(weights))
        weights[still] = scope.present[still]
    return weights


def _apart(job: JobInputs, splats: PreparedSplats, weights: Weights) -> Weights:
    """Weights (N, B) that do not cross the job's walls: ways around them are open to every method."""
    if job.scope.walls is None:
        return weights
    return keep_apart(weights, splats.cloud.means, job.scope.walls, splats.skeleton)[0]


def finish_weights(job: JobInputs, splats: PreparedSplats, weights: Weights) -> Weights:
    """The final weights (N, B) of a job: bad splats follow their nearest neighbour, the number of bones per splat is
    limited, and splats that may not change have their present weights."""
    weights = _apart(job, splats, follow_nearest(splats.cloud.means, weights, splats.ignored))
    if job.settings.max_influences:
        weights = sparsify(weights, job.settings.max_influences)
    return keep_present(job.scope, weights)


def finish_start(job: JobInputs, splats: PreparedSplats, start: Influences) -> Influences:
    """`finish_weights` for what the weights were before learning, so that only the learning differs."""
    numbers: Any = np.arange(len(start.index))[:, None]
    own = follow_nearest(splats.cloud.means, numbers, splats.ignored)[:, 0]
    start = start.rows(own)
    if job.scope.only is not None and job.scope.present is not None:
        still = np.flatnonzero(~job.scope.movable(len(own)))
        kept = Influences.strongest(job.scope.present[still], start.index.shape[1])
        start.index[still], start.value[still] = kept.index, kept.value
    return start


def weight_change(weights: Weights, initial: Weights) -> Weights:
    """Half the L1 distance of the rows (N,), by parts: copies of large clouds' weights are large."""
    change = np.empty(len(weights), np.float32)
    for first in range(0, len(weights), _ROWS):
        part = slice(first, first + _ROWS)
        change[part] = np.abs(weights[part] - initial[part]).sum(axis=1) / 2
    return change


def job_report(
    job: JobInputs,
    splats: PreparedSplats,
    weights: Weights,
    change: Weights,
    confidence: NDArray[np.float32] | None,
    eta: Eta,
    more: Mapping[str, Any],
) -> dict[str, Any]:
    """Numbers and words about a finished job; `more` comes from the recipe."""
    report = {
        "settings": job.settings.as_dict(),
        "splats": job.cloud.count,
        "splats_optimised": 0,
        "hygiene": splats.counts,
        "bones": job.skeleton.count,
        "guidance_images": 0,
        **more,
        "seconds": eta.stage_seconds,
        "mean_weight_change": float(change.mean()),
        "bones_without_splats": [
            name for name, most in zip(job.skeleton.names, weights.max(axis=0), strict=True) if most < 0.01
        ],
    }
    if confidence is not None:
        report["mean_confidence"] = float(confidence.mean())
    return report


def _seen_at_rest(cloud: SplatCloud, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """Splats (N,) that show in some view."""
    from ..render.rasterizer import prepare, view_colors
    from ..skinning.views import VISIBLE_WEIGHT

    visible = np.zeros(cloud.count, bool)
    for camera in cameras:
        scene = prepare(cloud.scales, view_colors(cloud, camera), cloud.opacities, backend="cpu")
        visible |= scene.contribution(cloud.means, cloud.quats, camera) > VISIBLE_WEIGHT
    return visible
