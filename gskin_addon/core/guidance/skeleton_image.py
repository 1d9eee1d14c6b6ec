# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a skeleton for image models that take reference images: bones as coloured limbs, joints as discs.

A bone has the same colour at rest and posed, so that two such pictures tell which limb went where.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera
from ..rig.segments import bone_segments
from ..rig.skeleton import Skeleton

DRAWING_VERSION = 1
"""Of the pictures: part of the identity of images that were made from them."""

THICKNESS, JOINT = 1 / 128, 1 / 80
"""Half the width of a limb and radius of a joint, as parts of the image's shorter side."""

GOLDEN = 0.618034
"""Step of the hue from bone to bone: neighbours in a skeleton's list differ, however many there are."""


@dataclass(frozen=True)
class DrawnBones:
    """The segments of a skeleton in one view.

    rest, posed (S, 2, 3): start and end of each segment as pixel position (x, y) and depth, (x, y) NaN behind the
    camera; bone (S,): the bone that each belongs to, which decides its colour.
    """

    rest: NDArray[np.float32]
    posed: NDArray[np.float32]
    bone: NDArray[np.int16]


def project_bones(skeleton: Skeleton, transforms: NDArray[Any], camera: Camera) -> DrawnBones:
    """The bones (`bone_segments`) at rest and in the pose `transforms` (B, 4, 4) as `camera` sees them."""
    segments = bone_segments(skeleton)
    rest = np.stack([segments.starts, segments.ends], axis=1)
    moves = transforms[segments.bone]
    posed = np.einsum("src,sjc->sjr", moves[:, :3, :3], rest) + moves[:, None, :3, 3]
    return DrawnBones(_seen(rest, camera), _seen(posed, camera), segments.bone.astype(np.int16))


def _seen(points: NDArray[np.float64], camera: Camera) -> NDArray[np.float32]:
    """Pixel positions and depths (..., 3) of world points (..., 3)."""
    pixels, depth = camera.project(points)
    return np.concatenate([pixels, depth[..., None]], axis=-1).astype(np.float32)


def bone_color(bone: int) -> tuple[float, float, float]:
    """RGB in [0, 1] of a bone by its number."""
    return colorsys.hsv_to_rgb(GOLDEN * bone % 1.0, 1.0, (1.0, 0.75)[bone // 2 % 2])


def draw_bones(segments: NDArray[Any], bone: NDArray[Any], size: tuple[int, int]) -> NDArray[np.uint8]:
    """The segments (S, 2, 3) of `DrawnBones` on black, (H, W, 3) uint8; the far ones first.

    A segment with an end behind the camera is left out. Joints are white discs with the colour of their bone inside.
    """
    height, width = size
    image = np.zeros((height, width, 3), np.float32)
    limb, joint = THICKNESS * min(size), JOINT * min(size)
    for number in np.argsort(-segments[:, :, 2].mean(axis=1), kind="stable"):
        ends = segments[number, :, :2].astype(np.float64)
        if not np.isfinite(ends).all():
            continue
        colour = np.array(bone_color(int(bone[number])), np.float32)
        reach = max(joint, 1.75) + 1.0
        low = np.clip(np.floor(ends.min(axis=0) - reach), 0, (width, height)).astype(int)
        high = np.clip(np.ceil(ends.max(axis=0) + reach) + 1, 0, (width, height)).astype(int)
        if (low >= high).any():
            continue  # outside the picture
        part = image[low[1] : high[1], low[0] : high[0]]
        at = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), axis=-1) + 0.5
        _lay(part, _distance(at, ends[0], ends[1]), max(limb, 1.25), colour)
        for end in ends:
            far = np.linalg.norm(at - end, axis=-1)
            _lay(part, far, max(joint, 1.75), np.ones(3, np.float32))
            _lay(part, far, max(0.6 * joint, 1.0), colour)
    return (image * 255 + 0.5).astype(np.uint8)


def _distance(at: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (H, W) of the positions `at` (H, W, 2) from a segment."""
    way = end - start
    along = np.clip((at - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
    return np.linalg.norm(at - start - along[..., None] * way, axis=-1)


def _lay(part: NDArray[np.float32], distance: NDArray[Any], radius: float, colour: NDArray[np.float32]) -> None:
    """Put `colour` on `part` (H, W, 3) where `distance` is below `radius`, with a rim one pixel soft."""
    cover = np.clip(radius + 0.5 - distance, 0.0, 1.0).astype(np.float32)[..., None]
    part += cover * (colour - part)
