# SPDX-License-Identifier: GPL-3.0-or-later
"""A rasteriser in numpy alone, for Pythons without numba: many splats' pixels ("fragments") at once.

The meaning is that of `reference.py`. Splats are taken near to far in runs of about `RUN` fragments. A run's
fragments are sorted by pixel, and each pixel's transmittance is a cumulative sum of log(1 - alpha) along them.
Pixels that have ended get no fragments any more, so what hidden splats cost is a look at their box.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .picture import Picture

RUN = 2_000_000
"""Fragments handled at once; about 100 bytes each."""

ALPHA_CUT = 1.0 / 255.0
ALPHA_MAX = 0.99
T_MIN = 1e-4
DILATION = 0.3

Floats = NDArray[np.floating[Any]]


def draw(
    means: Floats,
    quats: Floats,
    scales: Floats,
    colors: Floats,
    opacities: Floats,
    camera: Camera,
    limit: Floats | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Picture:
    """Picture of means (N,3), quats (N,4) wxyz, scales (N,3), colors (N,3) sRGB and opacities (N,).

    limit: (H,W) metres along the camera's z; splats whose centre lies behind it do not reach that pixel.
    on_progress is called with the share of the splats done, 0 to 1, after each run.
    """
    height, width = camera.size
    flat = flatten(means, quats, scales, opacities, camera)
    keys = flat.pop("splat")
    canvas = _Canvas(height * width, limit)
    tint = np.asarray(colors, np.float32)[keys]
    # Rows times columns of the box overestimates a thin slanted ellipse, which only makes a run smaller.
    area = (flat["right"] - flat["left"] + 1) * (flat["bottom"] - flat["top"] + 1)
    runs = np.cumsum(np.minimum(area, RUN)) // RUN
    cuts = np.flatnonzero(np.r_[True, runs[1:] != runs[:-1], True]) if len(runs) else np.zeros(0, np.int64)
    for first, last in pairwise(cuts.tolist()):
        part = {name: values[first:last] for name, values in flat.items()}
        seen = _open_inside(canvas.open.reshape(height, width), part)
        if seen.any():
            part = {name: values[seen] for name, values in part.items()}
            canvas.blend(*_spread(part, width), part["depth"], tint[first:last][seen])
        if on_progress is not None:
            on_progress(last / len(runs))
    shape = height, width
    return Picture(canvas.color.reshape(height, width, 3), 1.0 - canvas.T.reshape(shape), canvas.depth.reshape(shape))


def flatten(means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera) -> dict[str, Any]:
    """Columns (M,) of the M splats that show, near to far.

    Inverse image covariance a, b, c, log opacity k, mean x, y in pixels, depth in metres; left, right, top, bottom of
    the box of pixels, ends included; and which `splat` of the given ones it is.
    """
    m, o = np.asarray(means, np.float64), np.asarray(opacities, np.float64)
    x, y, z = camera.to_camera(m).T
    splat = np.flatnonzero((o >= ALPHA_CUT) & (z > camera.near) & np.isfinite(x + y))
    splat = splat[np.argsort(z[splat].astype(np.float32), kind="stable")]
    x, y, z, o = x[splat], y[splat], z[splat], o[splat]
    axes = _image_axes(x, y, z, np.asarray(quats, np.float64)[splat], np.asarray(scales, np.float64)[splat], camera)
    xx, xy, yy = (axes[:, 0] ** 2).sum(1), (axes[:, 0] * axes[:, 1]).sum(1), (axes[:, 1] ** 2).sum(1)
    # Without cancellation, as in the kernels.
    det = (np.cross(axes[:, 0], axes[:, 1]) ** 2).sum(1) + DILATION * (xx + yy) + DILATION**2
    xx, yy = xx + DILATION, yy + DILATION
    far = 1.0 if camera.orthographic else z
    mx, my = camera.fx * x / far + camera.cx, camera.fy * y / far + camera.cy
    reach = 2.0 * np.log(np.maximum(o / ALPHA_CUT, 1.0))
    rx, ry = np.sqrt(reach * xx), np.sqrt(reach * yy)
    box = {
        "left": np.maximum(np.ceil(mx - rx - 0.5), 0),
        "right": np.minimum(np.floor(mx + rx - 0.5), camera.width - 1),
        "top": np.maximum(np.ceil(my - ry - 0.5), 0),
        "bottom": np.minimum(np.floor(my + ry - 0.5), camera.height - 1),
    }
    shows = (box["left"] <= box["right"]) & (box["top"] <= box["bottom"]) & np.isfinite(det) & (det > 0.0)
    whole = {name: values[shows].astype(np.int64) for name, values in box.items()}
    floats = {"a": yy / det, "b": -xy / det, "c": xx / det, "k": np.log(o), "x": mx, "y": my, "depth": z}
    return {**{name: values[shows] for name, values in floats.items()}, **whole, "splat": splat[shows]}


def _image_axes(x: Floats, y: Floats, z: Floats, quats: Floats, scales: Floats, camera: Camera) -> Floats:
    """U (N,2,3) with U U^T the undilated image covariance; see `reference.image_axes`."""
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    w, i, j, k = (quats / np.where(norm > 0.0, norm, 1.0)).T
    rows = [
        [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
        [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
        [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
    ]
    turn = np.stack([np.stack(row, -1) for row in rows], 1) * scales[:, None, :]
    # A zero quaternion is no rotation: the determinant below is that of the dilation alone, but nothing is drawn.
    turn[norm[:, 0] == 0.0] = np.nan
    jacobian = np.zeros((len(x), 2, 3))
    if camera.orthographic:
        jacobian[:, 0, 0], jacobian[:, 1, 1] = camera.fx, camera.fy
    else:
        mx, my = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
        u = np.clip(x / z, -camera.cx / camera.fx - mx, (camera.width - camera.cx) / camera.fx + mx)
        v = np.clip(y / z, -camera.cy / camera.fy - my, (camera.height - camera.cy) / camera.fy + my)
        jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * u / z
        jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * v / z
    return np.asarray(jacobian @ camera.rotation @ turn)


def _open_inside(still_open: NDArray[np.bool_], part: dict[str, Any]) -> NDArray[np.bool_]:
    """Which splats' boxes hold a pixel that still blends: a sum over the box by a summed-area table."""
    table = np.zeros((still_open.shape[0] + 1, still_open.shape[1] + 1), np.int64)
    table[1:, 1:] = still_open.cumsum(0, dtype=np.int64).cumsum(1)
    top, bottom, left, right = part["top"], part["bottom"] + 1, part["left"], part["right"] + 1
    return np.asarray(table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left] > 0)


def _spread(part: dict[str, Any], width: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Fragments of splats in their order: which splat, which pixel (row * width + column), and log of alpha.

    Along a row the exponent is a parabola with its top on the ridge, so each row's span is exact.
    """
    rows = part["bottom"] - part["top"] + 1
    of_row = np.repeat(np.arange(len(rows)), rows)
    row = part["top"][of_row] + _counting(rows)
    a, b, c = part["a"][of_row], part["b"][of_row], part["c"][of_row]
    dy = row + 0.5 - part["y"][of_row]
    peak = part["k"][of_row] - 0.5 * (c - b * b / a) * dy * dy
    middle = part["x"][of_row] - b / a * dy - 0.5  # in pixel columns
    half = np.sqrt(np.maximum(2.0 * (peak - np.log(ALPHA_CUT)), 0.0) / a)
    first = np.maximum(np.ceil(middle - half), 0.0).astype(np.int64)
    last = np.minimum(np.floor(middle + half), width - 1.0).astype(np.int64)
    count = np.where(peak >= np.log(ALPHA_CUT), np.maximum(last - first + 1, 0), 0)
    of_span = np.repeat(np.arange(len(count)), count)
    column = first[of_span] + _counting(count)
    away = (column - middle[of_span]).astype(np.float32)
    log_alpha = peak.astype(np.float32)[of_span] - 0.5 * a.astype(np.float32)[of_span] * away * away
    return of_row[of_span], row[of_span] * width + column, log_alpha


def _counting(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """0, 1, ... count - 1 for each of the counts, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(int(ends[-1]) if len(ends) else 0) - np.repeat(ends - counts, counts)


class _Canvas:
    """The state of all pixels (P,): premultiplied colour, transmittance T, depth, and which still blend."""

    def __init__(self, pixels: int, limit: Floats | None) -> None:
        self.color = np.zeros((pixels, 3), np.float32)
        self.T = np.ones(pixels, np.float32)
        self.depth = np.full(pixels, np.inf, np.float32)
        self.open = np.ones(pixels, np.bool_)
        self._limit = None if limit is None else np.asarray(limit, np.float32).reshape(-1)
        if self._limit is not None:
            self.open = ~(self._limit <= 0.0)

    def blend(
        self, splat: NDArray[np.int64], pixel: NDArray[np.int64], log_alpha: Floats, depth: Floats, colors: Floats
    ) -> None:
        """Blend fragments that come near to far behind what is there; depth (M,) and colors (M,3) of the splats."""
        keep = self.open[pixel]
        if self._limit is not None:
            keep &= depth.astype(np.float32)[splat] <= self._limit[pixel]
        splat, pixel, log_alpha = splat[keep], pixel[keep], log_alpha[keep]
        if len(pixel) == 0:
            return
        # Sorting one number is several times faster than argsort; the place in the run keeps the order by depth.
        bits = len(pixel).bit_length()
        keys = (pixel.astype(np.uint64) << np.uint64(bits)) | np.arange(len(pixel), dtype=np.uint64)
        keys.sort()
        order = (keys & np.uint64((1 << bits) - 1)).astype(np.int64)
        splat, pixel = splat[order], pixel[order]
        alpha = np.minimum(np.exp(log_alpha[order]), np.float32(ALPHA_MAX))
        starts = np.flatnonzero(np.r_[True, pixel[1:] != pixel[:-1]])
        lengths = np.diff(np.r_[starts, len(pixel)])
        touched = pixel[starts]
        fall = np.log1p(-alpha.astype(np.float64))
        summed = np.cumsum(fall)
        behind = np.repeat(np.log(self.T[touched].astype(np.float64)) - (summed - fall)[starts], lengths) + summed
        after = np.exp(behind).astype(np.float32)  # transmittance behind each fragment
        before = after / (1.0 - alpha)
        kept = after > T_MIN
        weight = np.where(kept, before * alpha, np.float32(0.0))
        self.color[touched] += np.add.reduceat(weight[:, None] * colors[splat], starts)
        half = np.flatnonzero(kept & (after <= 0.5) & (before > 0.5))
        self.depth[pixel[half]] = depth[splat[half]]
        self.T[touched] = np.minimum.reduceat(np.where(kept, after, self.T[pixel]), starts)
        self.open[touched] = np.logical_and.reduceat(kept, starts)
