# SPDX-License-Identifier: GPL-3.0-or-later
"""Small jobs for the tests of the worker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.files import write_arrays
from gskin_addon.core.job.contract import write_job
from gskin_addon.core.job.scope import Scope, scope_file
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.cloud import SplatCloud

FAKE = Path(__file__).with_name("fake_worker.py")


def rod(count: int = 200, seed: int = 0) -> tuple[SplatCloud, Skeleton]:
    """A rod of splats along z, 2 m high, with a chain of two bones in it."""
    rng = np.random.default_rng(seed)
    means = rng.uniform((-0.1, -0.1, 0.0), (0.1, 0.1, 2.0), (count, 3))
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    cloud = SplatCloud(
        means,
        quats,
        rng.uniform(0.01, 0.03, (count, 3)),
        rng.uniform(0.5, 1, count),
        rng.normal(size=(count, 4, 3)),
    )
    heads, tails = np.array([[0, 0, 0], [0, 0, 1.0]]), np.array([[0, 0, 1.0], [0, 0, 2.0]])
    return cloud, Skeleton(("lower", "upper"), np.array([-1, 0]), heads, tails)


def make_job(folder: Path, **settings: Any) -> Path:
    """A rod as a job in `folder`; `act` is for fake_worker.py."""
    cloud, skeleton = rod()
    return write_job(folder, cloud, skeleton, settings)


def write_scope(folder: Path, scope: Scope) -> str:
    """A scope beside a job, as `prepare_job` writes it; returns its name, the setting `scope`."""
    name, arrays = scope_file(scope)
    write_arrays(folder / name, arrays)
    return name
