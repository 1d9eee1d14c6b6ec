# SPDX-License-Identifier: GPL-3.0-or-later
"""A small scene on which a rasteriser is compared with the CPU's before a job uses it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .camera import look_at
from .cpu import backend as cpu
from .photometric import photometric_loss


def worst_difference(prepare: Callable[..., Any]) -> float:
    """Largest of: mean image error, relative errors (L2) of the gradients of a batch, error of contributions."""
    rng = np.random.default_rng(0)
    count, poses = 300, 3
    constant = np.exp(rng.normal(-2.8, 0.6, (count, 3))), rng.random((count, 3)), rng.uniform(0.05, 0.98, count)
    means = rng.normal(0, 0.4, (poses, count, 3)).astype(np.float32)
    quats = rng.normal(size=(poses, count, 4)).astype(np.float32)
    cameras = [look_at(eye, (0, 0, 0), size=(72, 100)) for eye in ((0.2, -3, 0.3), (2.5, -2, 0), (-2, 2, 1))]
    losses = [photometric_loss(np.full((72, 100, 3), 90, np.uint8))] * poses
    scene, wanted = prepare(*constant, compensate=0.1), cpu.prepare(*constant, compensate=0.1)
    view = means[0], quats[0], cameras[0]
    errors = [float(np.abs(scene.forward(*view).image - wanted.forward(*view).image).mean())]
    errors.append(float(np.abs(scene.contribution(*view) - wanted.contribution(*view)).max()))
    batch = means, quats, cameras, losses
    pairs: Any = zip(scene.render_and_grad_many(*batch), wanted.render_and_grad_many(*batch), strict=True)
    for mine, theirs in pairs:
        errors.append(float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs)))
    return max(errors) if np.isfinite(errors).all() else float("inf")
