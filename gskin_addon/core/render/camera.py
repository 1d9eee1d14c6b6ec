# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras in OpenCV axes (x right, y down, z forward), and the views that the method uses.

Pixel (column i, row j) covers [i, i+1) x [j, j+1); its centre is (i + 0.5, j + 0.5). The world is Z-up and
right-handed, in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

FIELD_OF_VIEW = 36.0
"""Degrees across the image; moderate, so that limbs keep their proportions."""

PAPER_AZIMUTHS = {"front": 0.0, "back": 180.0, "front_left": 45.0, "front_right": -45.0}
"""Degrees from the front towards the object's own left."""

EVALUATION_AZIMUTHS = {**PAPER_AZIMUTHS, "left": 90.0, "right": -90.0}
"""The paper's four, and two more."""

VIEW_COUNTS = (1, 2, 4, 6)
"""How many of these views, from the first on, guidance images may be taken of: the paper's ablation."""

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: `rotation` (3,3) and `translation` (3,) take world to camera axes (x = R p + t).

    fx, fy, cx, cy, width and height are in pixels. Nothing nearer than `near` (metres, along z) is drawn.
    With `orthographic` all rays run along z, and fx and fy are pixels for each metre.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 0.01
    orthographic: bool = False

    @property
    def center(self) -> NDArray[np.float64]:
        """Position of the camera, (3,), world."""
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def forward(self) -> NDArray[np.float64]:
        """Unit view direction, (3,), world; also the axis of the paper's random joint rotations."""
        return self.rotation[2].copy()

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.height, self.width

    def to_camera(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) of the world in camera axes (..., 3)."""
        p: NDArray[np.float64] = np.asarray(points, np.float64) @ self.rotation.T + self.translation
        return p

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (..., 2) and depths (...,) of world points (..., 3).

        Points at or behind the camera (depth <= near) have pixel coordinates NaN and keep their depth.
        """
        p = self.to_camera(points)
        depth = p[..., 2]
        z = np.where(depth > self.near, 1.0 if self.orthographic else depth, np.nan)
        pixels = np.stack([self.fx * p[..., 0] / z + self.cx, self.fy * p[..., 1] / z + self.cy], axis=-1)
        return pixels, depth

    def resized(self, size: int | tuple[int, int]) -> Camera:
        """The same view on another pixel grid: `size` is the new width (aspect kept) or (height, width)."""
        if isinstance(size, tuple):
            height, width = size
        else:
            width, height = size, max(1, round(self.height * size / self.width))
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=int(width),
            height=int(height),
        )


def look_at(
    eye: ArrayLike,
    target: ArrayLike,
    up: ArrayLike = (0.0, 0.0, 1.0),
    *,
    size: int | tuple[int, int],
    fov: float = FIELD_OF_VIEW,
    near: float = 0.01,
) -> Camera:
    """A camera at `eye` looking at `target`.

    `fov` is in degrees across the shorter side, `size` = n or (height, width) in pixels. When the view is
    along `up`, another up is chosen. Raises InputError when eye and target coincide.
    """
    eye_, target_ = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    z = target_ - eye_
    length = float(np.linalg.norm(z))
    if not np.isfinite(length) or length < 1e-12:
        raise InputError("The camera stands on its target; move the eye or the target.")
    z = z / length
    x = np.cross(z, np.asarray(up, np.float64))
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0])
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    height, width = (size, size) if isinstance(size, int) else size
    focal = 0.5 * min(width, height) / np.tan(0.5 * np.radians(fov))
    return Camera(rotation, -rotation @ eye_, focal, focal, 0.5 * width, 0.5 * height, int(width), int(height), near)


def percentile_bounds(points: ArrayLike, percent: float = 0.2) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,), (3,) of the box of `points` (N,3) without the outermost `percent` % at each of its sides.

    Captured splats have floaters; framing them would make the object small.
    """
    p = np.asarray(points, np.float64).reshape(-1, 3)
    p = p[np.isfinite(p).all(axis=1)]
    if len(p) == 0:
        raise InputError("There are no points to frame; check that the splats are not empty.")
    return np.percentile(p, percent, axis=0), np.percentile(p, 100.0 - percent, axis=0)


def orbit_views(
    lower: ArrayLike,
    upper: ArrayLike,
    size: int | tuple[int, int],
    azimuths: Sequence[float],
    *,
    front: ArrayLike = (0.0, -1.0, 0.0),
    elevation: float = 0.0,
    margin: float = 0.1,
    fov: float = FIELD_OF_VIEW,
) -> list[Camera]:
    """Cameras around the box `lower`..`upper` (3,), all at one distance that shows the whole box.

    `azimuths` are degrees from `front` (the side where the front camera stands) towards the object's own
    left, `elevation` degrees upwards; `margin` is the part of the image left free at each edge (0..0.5).
    One distance for all views keeps the scale of the object equal between them.
    """
    lo, hi = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not (np.isfinite(lo).all() and np.isfinite(hi).all()) or (hi < lo).any():
        raise InputError("The bounds to frame are empty or not finite; check the splats for stray values.")
    if not 0.0 <= margin < 0.5:
        raise InputError(f"The margin {margin} is not in 0..0.5; take 0.1 for a tenth of the image.")
    front_ = np.asarray(front, np.float64) * (1.0, 1.0, 0.0)
    if np.linalg.norm(front_) < 1e-9:
        raise InputError("The front direction is vertical; give one with an x or y part, such as (0, -1, 0).")
    front_ = front_ / np.linalg.norm(front_)
    left = np.cross(_UP, front_)
    center, half = 0.5 * (lo + hi), np.maximum(0.5 * (hi - lo), 1e-6)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = center + signs * half
    e = np.radians(elevation)
    cameras = []
    for azimuth in np.radians(np.asarray(azimuths, np.float64)):
        side = np.cos(azimuth) * front_ + np.sin(azimuth) * left
        eye = center + np.cos(e) * side + np.sin(e) * _UP
        cameras.append(look_at(eye, center, size=size, fov=fov))
    distance = 0.0
    for camera in cameras:
        p = camera.to_camera(corners) - (0.0, 0.0, 1.0)
        tan_x = 0.5 * camera.width / camera.fx * (1.0 - 2.0 * margin)
        tan_y = 0.5 * camera.height / camera.fy * (1.0 - 2.0 * margin)
        distance = max(
            distance,
            float((np.abs(p[:, 0]) / tan_x - p[:, 2]).max()),
            float((np.abs(p[:, 1]) / tan_y - p[:, 2]).max()),
        )
    return [replace(c, translation=-c.rotation @ center + (0.0, 0.0, distance), near=0.01 * distance) for c in cameras]


def paper_views(
    lower: ArrayLike,
    upper: ArrayLike,
    size: int | tuple[int, int],
    front: ArrayLike = (0.0, -1.0, 0.0),
    margin: float = 0.1,
    *,
    fov: float = FIELD_OF_VIEW,
) -> list[Camera]:
    """The paper's guidance views [front, back, front-left, front-right] on the box; see orbit_views."""
    return orbit_views(lower, upper, size, list(PAPER_AZIMUTHS.values()), front=front, margin=margin, fov=fov)


def evaluation_views(
    lower: ArrayLike,
    upper: ArrayLike,
    size: int | tuple[int, int],
    front: ArrayLike = (0.0, -1.0, 0.0),
    margin: float = 0.1,
    *,
    fov: float = FIELD_OF_VIEW,
) -> list[Camera]:
    """The four guidance views and [left, right], framed on the box; see orbit_views."""
    return orbit_views(lower, upper, size, list(EVALUATION_AZIMUTHS.values()), front=front, margin=margin, fov=fov)
