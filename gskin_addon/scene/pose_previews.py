# SPDX-License-Identifier: GPL-3.0-or-later
"""Small pictures of splats in poses, for assets: drawn here, because Blender's need a camera, a window and the armature
as the active object, and show no true splats."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from ..core.render.camera import Camera, orbit_views, percentile_bounds
from ..core.render.fragments import draw
from ..core.rig.influences import Influences
from ..core.rig.lbs import skin_cloud
from ..core.skinning.subset import choose_subset
from ..core.splats.cloud import SH_C0, SplatCloud
from .influences import read_influences
from .splat_object import read_cloud
from .steps import Steps, in_thread, part_of

Array = NDArray[Any]

SIZE = 128
"""Pixels of Blender's previews."""
MOST = 12_000
"""Splats that one is drawn with."""
AZIMUTH, ELEVATION, MARGIN = 25.0, 8.0, 0.08
"""From where: degrees to the character's left and upwards, and what is left free around the rest pose."""
BEHIND = (0.19, 0.19, 0.19)


def iter_previews(
    splats: bpy.types.Object, transforms: Sequence[Array], front: ArrayLike
) -> Steps[list[Array]]:
    """Pictures (SIZE, SIZE, 4), sRGB from 0 to 1, of splats that follow bones of these transforms, each (B, 4, 4)."""
    cloud, stored = read_cloud(splats), read_influences(splats)
    if stored is None:
        raise InputError(f"'{splats.name}' follows no armature by weights of its own; bind it to one first.")
    subset = yield from in_thread(lambda: choose_subset(cloud, 0, MOST))
    index, value = (part[subset.index] for part in stored)
    weights = _dense(index, value, len(transforms[0]))
    camera = orbit_views(
        *percentile_bounds(cloud.means), SIZE, [AZIMUTH], front=front, elevation=ELEVATION, margin=MARGIN
    )[0]
    pictures = []
    for number, pose in enumerate(transforms):
        at = number / len(transforms), (number + 1) / len(transforms)
        drawing = in_thread(partial(_draw, subset.cloud, weights, pose, camera))
        pictures.append((yield from part_of(drawing, *at)))
    return pictures


def _dense(index: Array, value: Array, bones: int) -> Array:
    """Weights (M, B + 1) with rows that sum to 1; what has none follows the last, which never moves."""
    known = (index >= 0) & (value > 0)
    weights = Influences(np.where(known, index, bones), np.where(known, value, 0)).dense(bones + 1)
    weights[:, -1] = weights.sum(axis=1) <= 0
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)


def _draw(cloud: SplatCloud, weights: Array, pose: Array, camera: Camera) -> Array:
    posed = skin_cloud(cloud, weights, np.concatenate([pose, np.eye(4)[None]]), rotate_sh=False)
    colors = np.clip(0.5 + SH_C0 * cloud.sh[:, 0], 0, 1)
    picture = draw(posed.means, posed.quats, posed.scales, colors, posed.opacities, camera).over(BEHIND)
    return np.concatenate([picture, np.ones_like(picture[..., :1])], axis=-1)
