# SPDX-License-Identifier: GPL-3.0-or-later
"""The image loss (1 - w) L1 + w (1 - SSIM), w = 0.2, and its gradient to the image, in one numba kernel.

Where both images show the bare background the loss is zero, so only a box around the content is computed:
values equal those of the whole image when the box keeps 10 px (twice the SSIM window's half) around
everything that differs from the background.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import float32, njit
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .image_metrics import C1, C2, WINDOW, gaussian_window

Array = NDArray[np.float32]
Box = tuple[int, int, int, int]
"""(top, bottom, left, right) in pixels, end exclusive."""

DSSIM_WEIGHT = 0.2
MARGIN = 10

_HALF = WINDOW // 2
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(w) for w in gaussian_window()[: _HALF + 1])
_C1, _C2 = np.float32(C1), np.float32(C2)


@njit(cache=True, nogil=True)
def _across(row: Any, out: Any) -> None:
    """out (w,) = `row` (w + 10,), which has 5 zeros at each end, under the window."""
    for x in range(out.shape[0]):
        out[x] = (
            _W0 * (row[x] + row[x + 10])
            + _W1 * (row[x + 1] + row[x + 9])
            + _W2 * (row[x + 2] + row[x + 8])
            + _W3 * (row[x + 3] + row[x + 7])
            + _W4 * (row[x + 4] + row[x + 6])
            + _W5 * row[x + 5]
        )


@njit(cache=True, nogil=True)
def _down(plane: Any, y: int, out: Any) -> None:
    """out (w,) = row y of `plane` (h + 10, w), which has 5 zero rows at top and bottom, under the window."""
    a, b, c, d, e, f = plane[y], plane[y + 1], plane[y + 2], plane[y + 3], plane[y + 4], plane[y + 5]
    g, h, i, j, k = plane[y + 6], plane[y + 7], plane[y + 8], plane[y + 9], plane[y + 10]
    for x in range(out.shape[0]):
        out[x] = (
            _W0 * (a[x] + k[x])
            + _W1 * (b[x] + j[x])
            + _W2 * (c[x] + i[x])
            + _W3 * (d[x] + h[x])
            + _W4 * (e[x] + g[x])
            + _W5 * f[x]
        )


@njit(cache=True, nogil=True)
def _l1_dssim(image: Any, target: Any, top: int, left: int, weight: Any, scale: Any, grad: Any) -> float:
    """Sum over the box (the shape of `target`) of the loss; adds scale x gradient into grad (H,W,3) there."""
    h, w, channels = target.shape
    moments, maps = np.zeros((5, h + 10, w), np.float32), np.zeros((3, h + 10, w), np.float32)
    row, out = np.zeros((5, w + 10), np.float32), np.empty((5, w), np.float32)
    l1: Any = 0.0
    dssim: Any = 0.0
    one, two = float32(1.0), float32(2.0)
    l1_scale, ssim_scale = float32((1.0 - weight) * scale), float32(-weight * scale)
    for channel in range(channels):
        for y in range(h):
            for x in range(w):
                a, b = image[top + y, left + x, channel], target[y, x, channel]
                row[0, x + 5], row[1, x + 5] = a, b
                row[2, x + 5], row[3, x + 5], row[4, x + 5] = a * a, b * b, a * b
            for k in range(5):
                _across(row[k], moments[k, y + 5])
        for y in range(h):
            for k in range(5):
                _down(moments[k], y, out[k])
            total = float32(0.0)
            for x in range(w):
                ma, mb = out[0, x], out[1, x]
                saa, sbb, sab = out[2, x] - ma * ma, out[3, x] - mb * mb, out[4, x] - ma * mb
                a1, a2 = two * ma * mb + _C1, two * sab + _C2
                b1, b2 = ma * ma + mb * mb + _C1, saa + sbb + _C2
                both = one / (b1 * b2)
                s = a1 * a2 * both
                total += one - s
                d_aa, d_ab = -s * b1 * both, two * a1 * both  # dS/dE[aa], dS/dE[ab]
                out[0, x] = two * (mb * a2 * both - ma * s * b2 * both - ma * d_aa) - mb * d_ab  # dS/dE[a]
                out[1, x], out[2, x] = d_aa, d_ab
            dssim += total
            for k in range(3):
                row[k, 5 : w + 5] = out[k]
                _across(row[k], maps[k, y + 5])
        for y in range(h):
            for k in range(3):
                _down(maps[k], y, out[k])
            total = float32(0.0)
            for x in range(w):
                a, b = image[top + y, left + x, channel], target[y, x, channel]
                d = a - b
                total += abs(d)
                sign = float32(np.sign(d))
                grad[top + y, left + x, channel] = l1_scale * sign + ssim_scale * (
                    out[0, x] + two * a * out[1, x] + b * out[2, x]
                )
            l1 += total
    return (1.0 - weight) * l1 + weight * dssim


def l1_dssim(
    image: ArrayLike, target: ArrayLike, *, weight: float = DSSIM_WEIGHT, box: Box | None = None
) -> tuple[float, Array]:
    """(1 - weight) mean|image - target| + weight (1 - mean SSIM), and its gradient to the image (H,W,3).

    Images (H,W,3) in 0..1. With `box` only that part is compared, and the rest counts as equal.
    """
    a, b = np.asarray(image, np.float32), np.asarray(target, np.float32)
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(
            f"Images of shapes {a.shape} and {b.shape} cannot be compared; give two (H,W,3) of one size."
        )
    y0, y1, x0, x1 = (0, a.shape[0], 0, a.shape[1]) if box is None else box
    return _boxed(a, np.ascontiguousarray(b[y0:y1, x0:x1]), y0, x0, weight)


def _boxed(image: Array, part: Array, top: int, left: int, weight: float) -> tuple[float, Array]:
    grad = np.zeros(image.shape, np.float32)
    value: Any = 0.0
    if part.size:
        value = _l1_dssim(np.ascontiguousarray(image), part, top, left, weight, 1.0 / image.size, grad)
    return float(value) / image.size, grad


def content_box(differs: ArrayLike, margin: int = MARGIN) -> Box:
    """Box around the True pixels of a mask (H,W), `margin` px wider, within the image; zeros if none."""
    mask = np.asarray(differs, bool)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return 0, 0, 0, 0
    return (
        max(int(rows[0]) - margin, 0),
        min(int(rows[-1]) + 1 + margin, mask.shape[0]),
        max(int(columns[0]) - margin, 0),
        min(int(columns[-1]) + 1 + margin, mask.shape[1]),
    )


def union(a: Box, b: Box) -> Box:
    """Smallest box around both; an empty one counts for nothing."""
    if a[1] <= a[0]:
        return b
    if b[1] <= b[0]:
        return a
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def photometric_loss(
    target: ArrayLike,
    background: ArrayLike = (1.0, 1.0, 1.0),
    *,
    weight: float = DSSIM_WEIGHT,
    box: Box | None = None,
) -> Callable[[Array, Array], tuple[float, Array]]:
    """The loss of one guidance image, for `scene.render_and_grad`: (image, alpha) -> (value, gradient).

    `target` (H,W,3), uint8 or float in 0..1, over `background` (3,); `box` is its content_box where known.
    """
    t = np.asarray(target)
    back = np.asarray(background, np.float32)
    scale = np.float32(1.0 / 255.0) if t.dtype == np.uint8 else np.float32(1.0)
    if box is None:
        box = content_box((np.abs(t.astype(np.float32) * scale - back) > 1e-6).any(axis=2))
    known = box

    def loss(image: Array, alpha: Array) -> tuple[float, Array]:
        if image.shape != t.shape:
            raise InputError(
                f"The render is {image.shape}, its guidance image {t.shape}; give both one size."
            )
        y0, y1, x0, x1 = union(known, content_box(alpha > 0.0))
        part = np.ascontiguousarray(t[y0:y1, x0:x1].astype(np.float32) * scale)
        return _boxed(image, part, y0, x0, weight)

    return loss
