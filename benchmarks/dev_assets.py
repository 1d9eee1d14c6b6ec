# SPDX-License-Identifier: GPL-3.0-or-later
"""Small learning problems on assets that no headline table uses: what sweeps and ablations decide on.

The assets are marked `eval_candidate: false` in the shared catalogue: a hand in flat colours, a horse of loose
parts, a clothed MakeHuman person, and a bat with a thin tail. Everything but the optimiser runs once per asset and
guidance: 5,000 splats, 192 px, 12 poses for each of the paper's four views.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import RiggedSplats, load_asset
from benchmarks.metrics import held_out_poses
from gskin_addon.core.guidance import create_provider
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.pipeline.steps import to_unit_size
from gskin_addon.core.render.camera import evaluation_views, percentile_bounds
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.lbs import skin_points, sparsify
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.fields import create_field
from gskin_addon.core.skinning.geodesic import body_distances
from gskin_addon.core.skinning.initial import initial_weights
from gskin_addon.core.skinning.losses import LossWeights
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser, Target
from gskin_addon.core.skinning.presets import Preset
from gskin_addon.core.skinning.subset import choose_subset
from gskin_addon.core.splats.cloud import SplatCloud

DEV = ("gxr_hand_r", "pm_low_poly_horse", "mh_008", "oc_Bat")
GUIDANCE = ("oracle", "elastic")
SIZE, SPLATS, POSES, HELD_OUT = 192, 5000, 12, 2
SCHEDULE = Preset("for sweeps", POSES, ((96, 50), (192, 60)), 4, patience=0)
"""About the draft preset's course at small sizes."""

MORE_VIEWS = {1: (0,), 2: (0, 1), 4: (0, 1, 2, 3), 6: (0, 1, 2, 3, 4, 5)}
"""Number of views -> which of [front, back, front-left, front-right, left, right]."""


@dataclass(frozen=True)
class Case:
    """One asset in unit size with guidance images ready; rows are the splats in the optimiser's order.

    truth, initial (M, B); targets, held_out: images of the views; poses (P, B, 4, 4): unseen ones to judge by.
    """

    name: str
    guidance: str
    cloud: SplatCloud
    skeleton: Skeleton
    truth: NDArray[np.float32]
    initial: NDArray[np.float32]
    targets: list[Target]
    held_out: list[Target]
    poses: NDArray[np.float64]

    def error(self, weights: NDArray[np.floating]) -> float:
        """Mean distance to the true posed position, % of the diagonal, of weights cut to four bones."""
        points = self.cloud.means.astype(np.float64)
        lower, upper = self.cloud.bounds()
        moved = skin_points(points, sparsify(weights, 4), self.poses) - skin_points(points, self.truth, self.poses)
        return float(np.linalg.norm(moved, axis=-1).mean() / np.linalg.norm(upper - lower) * 100)

    def learn(
        self,
        losses: LossWeights | None = None,
        preset: Preset = SCHEDULE,
        *,
        field: str = "pyramid",
        field_options: Mapping[str, Any] | None = None,
        seed: int = 0,
        **options: Any,
    ) -> NDArray[np.float32]:
        """Weights (M, B) after a run with these settings; `options` go to the optimiser."""
        made = create_field(field, self.cloud.means, self.initial, field_options)
        optimiser = Optimiser(
            self.cloud,
            self.skeleton,
            made,
            self.targets,
            preset,
            options=LearningOptions(losses=losses or LossWeights(), seed=seed, **options),
        )
        for _ in range(preset.iterations):
            optimiser.step()
        return optimiser.weights()


@lru_cache(maxsize=64)
def case(name: str, guidance: str, views: int = 4, splats: int = SPLATS, size: int = SIZE) -> Case:
    """The learning problem of an asset; FileNotFoundError where the assets are not on this machine."""
    asset: RiggedSplats = load_asset(name, splats)
    whole, skeleton = to_unit_size(asset.cloud, asset.skeleton)
    subset = choose_subset(whole, seed=0)
    cloud, truth = subset.cloud, asset.weights[subset.index]
    around = evaluation_views(*percentile_bounds(whole.means), size)
    masks = np.stack([render_cloud(cloud, camera)[1] > 0.5 for camera in around[:4]])
    initial = initial_weights("visibility", cloud, skeleton, masks, around[:4])
    context = GuidanceContext(cloud, skeleton, initial, body_distances(cloud, skeleton))
    provider = Oracle(context, truth) if guidance == "oracle" else create_provider(guidance, context)
    cameras = [around[k] for k in MORE_VIEWS[views]]
    sets = []
    for count, seed in ((POSES, 0), (HELD_OUT, 1)):
        signals = make_signals(skeleton, cameras, count, np.random.default_rng(seed))
        images = provider.images(signals)
        sets.append([Target(s.camera, s.transforms, i) for s, i in zip(signals, images, strict=True)])
    poses = held_out_poses(skeleton, 24, 977)
    return Case(name, guidance, cloud, skeleton, truth, initial, sets[0], sets[1], poses)
