# SPDX-License-Identifier: GPL-3.0-or-later
"""The image loss (1 - w) L1 + w (1 - SSIM), w = 0.2, and its gradient to the image, in one numba kernel.

Where both images show the bare background the loss is zero, so only a box around the content is computed:
values equal those of the whole image when the box keeps 10 px (twice the SSIM window's half) around
everything that differs from the background.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import float32, njit
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .cpu.vec8 import broadcast, fma, load, store
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
def _window(a: Any, at: Any, x: int) -> Any:
    """Eight columns from x on: the sum of window[j] * a[at[j] + x] over the 11 offsets `at`."""
    return fma(
        broadcast(_W0), load(a, at[0] + x) + load(a, at[10] + x),
        fma(broadcast(_W1), load(a, at[1] + x) + load(a, at[9] + x),
            fma(broadcast(_W2), load(a, at[2] + x) + load(a, at[8] + x),
                fma(broadcast(_W3), load(a, at[3] + x) + load(a, at[7] + x),
                    fma(broadcast(_W4), load(a, at[4] + x) + load(a, at[6] + x),
                        broadcast(_W5) * load(a, at[5] + x))))),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _ring(newest: int, stride: int) -> Any:
    """Offsets of a ring's 11 rows, the oldest first."""
    n = newest + 1
    return (
        n % 11 * stride, (n + 1) % 11 * stride, (n + 2) % 11 * stride, (n + 3) % 11 * stride, (n + 4) % 11 * stride,
        (n + 5) % 11 * stride, (n + 6) % 11 * stride, (n + 7) % 11 * stride, (n + 8) % 11 * stride,
        (n + 9) % 11 * stride, newest * stride,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _blur_row(row: Any, rings: Any, count: int, slot: int, stride: int) -> None:
    """Write the first `count` rows of `row` (n,stride) under the window to row `slot` of the rings (n,11*stride)."""
    for k in range(count):
        for x in range(0, stride - 16, 8):
            store(rings[k], slot * stride + x, _window(row[k], (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10), x))


@njit(cache=True, nogil=True)
def _l1_dssim(image: Any, target: Any, top: int, left: int, weight: Any, scale: Any, grad: Any) -> float:
    """Sum over the box (the shape of `target`) of the loss; writes scale x gradient into grad (H,W,3) there.

    Streams down the rows: the blurred moments of the last 11 rows give a row of SSIM and of its derivatives, and
    the blurred derivatives of the last 11 of those rows give a row of the gradient.
    """
    h, w, channels = target.shape
    stride = (w + 7) // 8 * 8 + 16
    moments, maps = np.empty((5, 11 * stride), np.float32), np.empty((3, 11 * stride), np.float32)
    row, terms, out = (
        np.empty((5, stride), np.float32),
        np.empty((3, stride), np.float32),
        np.empty((3, stride), np.float32),
    )
    c1, c2, one, two = broadcast(_C1), broadcast(_C2), broadcast(float32(1.0)), broadcast(float32(2.0))
    l1_scale, ssim_scale = float32((1.0 - weight) * scale), float32(-weight * scale)
    l1: Any = 0.0
    dssim: Any = 0.0
    for channel in range(channels):
        moments[:], maps[:], row[:], terms[:] = 0.0, 0.0, 0.0, 0.0
        for t in range(h + 10):
            newest = t % 11
            if t < h:
                for x in range(w):
                    a, b = image[top + t, left + x, channel], target[t, x, channel]
                    row[0, x + 5], row[1, x + 5] = a, b
                    row[2, x + 5], row[3, x + 5], row[4, x + 5] = a * a, b * b, a * b
                _blur_row(row, moments, 5, newest, stride)
            else:
                moments[:, newest * stride : (newest + 1) * stride] = 0.0
            y = t - 5
            if 0 <= y < h:
                at = _ring(newest, stride)
                for x in range(0, w, 8):
                    ma, mb = _window(moments[0], at, x), _window(moments[1], at, x)
                    saa = _window(moments[2], at, x) - ma * ma
                    sbb = _window(moments[3], at, x) - mb * mb
                    sab = _window(moments[4], at, x) - ma * mb
                    a1, a2 = fma(two * ma, mb, c1), fma(two, sab, c2)
                    b1, b2 = ma * ma + mb * mb + c1, saa + sbb + c2
                    both = one / (b1 * b2)
                    s = a1 * a2 * both
                    d_aa, d_ab = s * b1 * both, two * a1 * both  # -dS/dE[aa], dS/dE[ab]
                    store(out[0], x, one - s)
                    store(terms[0], x + 5, two * (mb * a2 * both - ma * s * b2 * both + ma * d_aa) - mb * d_ab)
                    store(terms[1], x + 5, d_aa)
                    store(terms[2], x + 5, d_ab)
                total = float32(0.0)
                for x in range(w):
                    total += out[0, x]
                dssim += total
                terms[:, w + 5 :] = 0.0
                _blur_row(terms, maps, 3, y % 11, stride)
            elif y >= h:
                maps[:, y % 11 * stride : (y % 11 + 1) * stride] = 0.0
            z = t - 10
            if z >= 0:
                at = _ring(y % 11, stride)
                for k in range(3):
                    for x in range(0, w, 8):
                        store(out[k], x, _window(maps[k], at, x))
                total = float32(0.0)
                for x in range(w):
                    a, b = image[top + z, left + x, channel], target[z, x, channel]
                    total += abs(a - b)
                    ssim_part = out[0, x] - float32(2.0) * a * out[1, x] + b * out[2, x]
                    grad[top + z, left + x, channel] = l1_scale * np.sign(a - b) + ssim_scale * ssim_part
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
        raise InputError(f"Images of shapes {a.shape} and {b.shape} cannot be compared; give two (H,W,3) of one size.")
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


@dataclass(frozen=True, eq=False)
class PhotometricLoss:
    """The loss of one guidance image; made by `photometric_loss`. Backends that know it compute it themselves.

    target (H,W,3), uint8 or float in 0..1; box: where it differs from the background; uploaded: copies of the
    target that backends keep, by device.
    """

    target: NDArray[Any]
    box: Box
    weight: float
    uploaded: dict[str, Any] = field(default_factory=dict)

    def __call__(self, image: Array, alpha: Array) -> tuple[float, Array]:
        """Value and gradient to the image (H,W,3) of a render and its alpha (H,W)."""
        self.check(image.shape)
        y0, y1, x0, x1 = union(self.box, content_box(alpha > 0.0))
        scale = np.float32(1.0 / 255.0) if self.target.dtype == np.uint8 else np.float32(1.0)
        part = np.ascontiguousarray(self.target[y0:y1, x0:x1].astype(np.float32) * scale)
        return _boxed(image, part, y0, x0, self.weight)

    def check(self, shape: tuple[int, ...]) -> None:
        """InputError if a render has another shape."""
        if tuple(shape) != self.target.shape:
            raise InputError(f"The render is {shape}, its guidance image {self.target.shape}; give both one size.")


def photometric_loss(
    target: ArrayLike,
    background: ArrayLike = (1.0, 1.0, 1.0),
    *,
    weight: float = DSSIM_WEIGHT,
    box: Box | None = None,
) -> PhotometricLoss:
    """The loss of one guidance image, for `scene.render_and_grad`: (image, alpha) -> (value, gradient).

    `target` (H,W,3), uint8 or float in 0..1, over `background` (3,); `box` is its content_box where known.
    """
    t = np.asarray(target)
    if box is None:
        scale = np.float32(1.0 / 255.0) if t.dtype == np.uint8 else np.float32(1.0)
        back = np.asarray(background, np.float32)
        box = content_box((np.abs(t.astype(np.float32) * scale - back) > 1e-6).any(axis=2))
    return PhotometricLoss(t, box, weight)
