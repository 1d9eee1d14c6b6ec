# SPDX-License-Identifier: GPL-3.0-or-later
"""What a method of weighting is given and what it gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import RiggedSplats, Surface
from gskin_addon.core.render.camera import Camera, paper_views, percentile_bounds
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.segments import bone_segments, segment_distance
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.cloud import SplatCloud

Array = NDArray[Any]
MASK_SIZE = 512


class Unavailable(Exception):
    """The method cannot run on this machine or in this version; says why. Not a failure of the method."""


@dataclass(frozen=True)
class MethodInput:
    """One asset as a method sees it: its splats and `skeleton`, which may be a disturbed copy of the asset's own.

    `asset` is for methods that know more than a user of splats does (the true mesh, the true weights);
    truth (N, B): the true weights on `skeleton`, or None where they mean nothing there.
    """

    asset: RiggedSplats
    skeleton: Skeleton
    truth: NDArray[np.float32] | None

    @property
    def cloud(self) -> SplatCloud:
        """The splats."""
        return self.asset.cloud

    @property
    def surface(self) -> Surface:
        """The true mesh and where the splats are on it."""
        if self.asset.surface is None:
            raise Unavailable("the splats come from no mesh")
        return self.asset.surface

    @cached_property
    def cameras(self) -> list[Camera]:
        """The four views of the paper, as a job has them."""
        return paper_views(*percentile_bounds(self.cloud.means), MASK_SIZE)

    @cached_property
    def masks(self) -> NDArray[np.bool_]:
        """(4, H, W) where the object covers the image."""
        return np.stack([render_cloud(self.cloud, camera)[1] > 0.5 for camera in self.cameras])


@dataclass(frozen=True)
class MethodResult:
    """weights (N, B); note: what a reader of the tables must know; partly: some splats got none by the method
    itself and follow their nearest bone; mesh_weights (W, B): of the vertices of the asset's welded mesh, where the
    method has such."""

    weights: NDArray[np.floating]
    note: str = ""
    partly: bool = False
    mesh_weights: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class Method:
    """A way to make weights, in at most `limit` core-seconds."""

    make: Callable[[MethodInput], MethodResult]
    limit: float = 300.0


def nearest_bone(points: Array, skeleton: Skeleton) -> Array:
    """Index (N,) of the bone nearest to each point, by what the bones really span (`bone_segments`)."""
    segments = bone_segments(skeleton)
    best, found = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    for start, end, bone in zip(segments.starts, segments.ends, segments.bone, strict=True):
        distance = segment_distance(points, start, end)
        closer = distance < best
        best[closer], found[closer] = distance[closer], bone
    return found


def rigid_weights(points: Array, skeleton: Skeleton) -> NDArray[np.float32]:
    """Weights (N, B): each point follows its nearest bone alone."""
    weights = np.zeros((len(points), skeleton.count), np.float32)
    weights[np.arange(len(points)), nearest_bone(points, skeleton)] = 1
    return weights


def complete(weights: Array, points: Array, skeleton: Skeleton) -> tuple[NDArray[np.float32], int]:
    """Weights (N, B) normalised, where rows without any follow the nearest bone; and how many those are."""
    weights = np.nan_to_num(np.maximum(weights, 0), posinf=0.0).astype(np.float32)
    total = weights.sum(axis=1, keepdims=True)
    bare = total[:, 0] <= 1e-6
    weights /= np.where(bare[:, None], 1, total)
    if bare.any():
        weights[bare] = rigid_weights(points[bare], skeleton)
    return weights, int(bare.sum())
