# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU rasteriser: prepared scenes that run the numba kernels on a small thread pool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from ..camera import Camera
from .blend import backward_tiles, forward_tiles
from .project import CAMERA, RECORD, TILE, count_tiles, depth_order, fill_tiles, project, project_backward
from .threads import parallel_for, row_ranges, run_tasks, thread_count

Array = NDArray[np.float32]
ImageLoss = Callable[[Array, Array], tuple[float, Array]]
"""(image, alpha) -> (value, gradient to the image)"""

DILATION = 0.3
"""Pixels^2 added to every image covariance, as 3DGS does."""

_NONE = np.zeros(0, np.float32)


def _tile_ranges(tile_start: NDArray[np.int64], threads: int) -> list[tuple[int, int]]:
    """Runs of tiles with about the same number of splats each, some per thread so that none waits long."""
    tiles = len(tile_start) - 1
    if threads <= 1:
        return [(0, tiles)]
    parts = 4 * threads
    work = tile_start + 8 * np.arange(tiles + 1)  # an empty tile costs its background
    cuts = np.searchsorted(work, np.linspace(0, work[-1], parts + 1))
    cuts[0], cuts[-1] = 0, tiles
    return [(int(a), int(b)) for a, b in pairwise(cuts) if b > a]


def camera_vector(camera: Camera, dilation: float = DILATION, compensate: float | None = None) -> NDArray[np.float64]:
    """The camera and the filter as the kernels read them, (CAMERA,) float64. InputError for an orthographic one."""
    if camera.orthographic:
        raise InputError("Guidance needs a perspective camera; orthographic views are drawn by *Render Splats* only.")
    c = np.zeros(CAMERA)
    c[0:9], c[9:12] = camera.rotation.ravel(), camera.translation
    c[12], c[13], c[14] = camera.fx, camera.fy, camera.near
    # Slopes of the image's edges, and 15 % of the width beyond (gsplat's bounds).
    mx, my = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    c[16], c[17] = -camera.cx / camera.fx - mx, (camera.width - camera.cx) / camera.fx + mx
    c[18], c[19] = -camera.cy / camera.fy - my, (camera.height - camera.cy) / camera.fy + my
    c[20], c[21] = dilation, -1.0 if compensate is None else compensate
    c[22], c[23] = camera.cx, camera.cy
    return c


@dataclass(frozen=True)
class Frame:
    """What a forward pass stores for its backward pass; `image` (H,W,3) and `alpha` (H,W) are its result."""

    image: Array
    alpha: Array
    means: Array
    quats: Array
    colors: Array
    camera: NDArray[np.float64]
    pixels: NDArray[np.float64]
    record: Array
    first_slot: NDArray[np.int64]
    tile_start: NDArray[np.int64]
    slots: NDArray[np.int32]
    owner: NDArray[np.int32]
    threads: int


@dataclass(frozen=True)
class CpuScene:
    """Splats whose scales (N,3), colors (N,3) and opacities (N,) stay while their means and quats move."""

    scales: Array
    colors: Array
    opacities: Array
    dilation: float = DILATION
    compensate: float | None = None

    def forward(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        camera: Camera,
        background: ArrayLike = (1.0, 1.0, 1.0),
        *,
        colors: ArrayLike | None = None,
        threads: int | None = None,
    ) -> Frame:
        """Render means (N,3) and quats (N,4) wxyz (normalised here); `colors` (N,3) replaces the scene's for
        once.

        `threads=1` stays in the calling thread (for callers that give each thread an image of its own).
        """
        return self._forward(means, quats, camera, background, colors, threads)[0]

    def backward(self, frame: Frame, grad_image: ArrayLike, grad_alpha: ArrayLike | None = None) -> tuple[Array, Array]:
        """Gradients to means (N,3) and quats (N,4) from those to the image (H,W,3) and to alpha (H,W)."""
        gi = np.ascontiguousarray(grad_image, np.float32)
        ga = np.zeros((0, 0), np.float32) if grad_alpha is None else np.ascontiguousarray(grad_alpha, np.float32)
        f = frame
        sums = np.empty((len(f.owner), 6), np.float32)
        parallel_for(
            backward_tiles, _tile_ranges(f.tile_start, f.threads), f.pixels, f.record, f.colors, f.tile_start, f.slots,
            f.owner, f.image, f.alpha, gi, ga, sums,
        )  # fmt: skip
        grad_means, grad_quats = np.empty_like(f.means), np.empty_like(f.quats)
        parallel_for(
            project_backward, row_ranges(len(f.means), f.threads), f.means, f.quats, self.scales, f.camera,
            f.first_slot, sums, grad_means, grad_quats,
        )  # fmt: skip
        return grad_means, grad_quats

    def render(
        self, means: ArrayLike, quats: ArrayLike, camera: Camera, background: ArrayLike = (1.0, 1.0, 1.0)
    ) -> tuple[Array, Array]:
        """(image (H,W,3), alpha (H,W)); see forward."""
        frame = self.forward(means, quats, camera, background)
        return frame.image, frame.alpha

    def render_and_grad(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        camera: Camera,
        loss: ImageLoss,
        background: ArrayLike = (1.0, 1.0, 1.0),
        *,
        threads: int | None = None,
    ) -> tuple[float, Array, Array]:
        """Value of `loss(image, alpha) -> (value, grad_image)`, gradients to means (N,3) and quats (N,4)."""
        frame = self.forward(means, quats, camera, background, threads=threads)
        value, grad = loss(frame.image, frame.alpha)
        return (value, *self.backward(frame, grad))

    def render_and_grad_many(
        self,
        means: Array,
        quats: Array,
        cameras: Sequence[Camera],
        losses: Sequence[ImageLoss],
        background: ArrayLike = (1.0, 1.0, 1.0),
    ) -> tuple[NDArray[np.float64], Array, Array]:
        """render_and_grad for P images, one per thread: means (P,N,3), quats (P,N,4), P cameras and losses.

        Returns values (P,), grad_means (P,N,3) and grad_quats (P,N,4).
        """
        scenes = [self] * len(cameras)
        values, *grads = render_and_grad_each(scenes, list(means), list(quats), cameras, losses, background)
        return values, np.stack(grads[0]), np.stack(grads[1])

    def contribution(self, means: ArrayLike, quats: ArrayLike, camera: Camera) -> Array:
        """Largest blending weight T alpha of each splat over the view's pixels, (N,); 0 if it is not seen."""
        frame, weight = self._forward(means, quats, camera, (0.0, 0.0, 0.0), None, None, weights=True)
        most = np.zeros(len(frame.means), np.float32)
        np.maximum.at(most, frame.owner, weight)
        return most

    def _forward(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        camera: Camera,
        background: ArrayLike,
        colors: ArrayLike | None,
        threads: int | None,
        weights: bool = False,
    ) -> tuple[Frame, Array]:
        n = len(self.scales)
        c = self.colors if colors is None else np.ascontiguousarray(colors, np.float32)
        m, q = check_splats(means, quats, c, n)
        threads = thread_count() if threads is None else threads
        height, width = camera.size
        columns = (width + TILE - 1) // TILE
        vector = camera_vector(camera, self.dilation, self.compensate)
        pixels, record, depth = np.empty((n, 2)), np.empty((n, RECORD), np.float32), np.zeros(n, np.float32)
        rect, tiles = np.empty((n, 4), np.int32), np.empty(n, np.int32)
        parallel_for(
            project, row_ranges(n, threads), m, q, self.scales, self.opacities, vector, width, height, pixels, record,
            depth, rect, tiles,
        )  # fmt: skip
        tile_start = np.empty(columns * ((height + TILE - 1) // TILE) + 1, np.int64)
        first_slot = np.empty(n + 1, np.int64)
        count_tiles(rect, tiles, columns, first_slot, tile_start)
        order, spare = np.empty(n, np.uint64), np.empty(n, np.uint64)
        order = order[: depth_order(tiles, depth.view(np.uint32), order, spare)]
        slots, owner = np.empty(int(first_slot[-1]), np.int32), np.empty(int(first_slot[-1]), np.int32)
        fill_tiles(order, rect, columns, first_slot, tile_start, slots, owner)
        image, alpha = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
        weight = np.zeros(len(owner), np.float32) if weights else _NONE
        back = np.ascontiguousarray(background, np.float32)
        parallel_for(
            forward_tiles, _tile_ranges(tile_start, threads), pixels, record, c, back, tile_start, slots, owner, image,
            alpha, weight,
        )  # fmt: skip
        frame = Frame(image, alpha, m, q, c, vector, pixels, record, first_slot, tile_start, slots, owner, threads)
        return frame, weight


def render_and_grad_each(
    scenes: Sequence[CpuScene],
    means: Sequence[Array],
    quats: Sequence[Array],
    cameras: Sequence[Camera],
    losses: Sequence[ImageLoss],
    background: ArrayLike = (1.0, 1.0, 1.0),
) -> tuple[NDArray[np.float64], list[Array], list[Array]]:
    """CpuScene.render_and_grad for P images, each of a scene of its own, one per thread.

    Returns values (P,), and for each image the gradients to its means (N_p,3) and quats (N_p,4).
    """
    count = len(cameras)
    values = np.zeros(count)
    grads: list[tuple[Array, Array]] = [(_NONE, _NONE)] * count
    alone = count >= thread_count()

    def one(p: int) -> None:
        value, grad_means, grad_quats = scenes[p].render_and_grad(
            means[p], quats[p], cameras[p], losses[p], background, threads=1 if alone else None
        )
        values[p], grads[p] = value, (grad_means, grad_quats)

    if alone:
        run_tasks([partial(one, p) for p in range(count)])
    else:
        for p in range(count):
            one(p)
    return values, [g[0] for g in grads], [g[1] for g in grads]


def check_splats(means: ArrayLike, quats: ArrayLike, colors: Array | None, count: int) -> tuple[Array, Array]:
    """means (N,3) and quats (N,4) as float32. InputError if they or colors (N,3) do not have `count` rows."""
    m, q = np.ascontiguousarray(means, np.float32), np.ascontiguousarray(quats, np.float32)
    c = np.zeros((count, 3)) if colors is None else colors
    if m.shape != (count, 3) or q.shape != (count, 4) or c.shape != (count, 3):
        raise InputError(
            f"The scene has {count} splats, but means, quats and colors have the shapes "
            f"{m.shape}, {q.shape} and {c.shape}; give one row per splat."
        )
    return m, q


def check_scene(scales: ArrayLike, colors: ArrayLike, opacities: ArrayLike) -> tuple[Array, Array, Array]:
    """scales (N,3), colors (N,3) and opacities (N,) as float32. InputError if they do not belong together."""
    s, c = np.ascontiguousarray(scales, np.float32), np.ascontiguousarray(colors, np.float32)
    o = np.ascontiguousarray(opacities, np.float32).reshape(-1)
    if s.shape != (len(o), 3) or c.shape != (len(o), 3):
        raise InputError(
            f"Scales {s.shape}, colors {c.shape} and opacities {o.shape} do not belong together; "
            "give (N,3), (N,3) and (N,)."
        )
    return s, c, o


def prepare(
    scales: ArrayLike,
    colors: ArrayLike,
    opacities: ArrayLike,
    *,
    dilation: float = DILATION,
    compensate: float | None = None,
) -> CpuScene:
    """A scene of scales (N,3) linear, colors (N,3) and opacities (N,) in 0..1, which carry no gradient.

    `dilation` is added to the image covariance (pixels^2). `compensate` = e multiplies each opacity by
    sqrt(det(S + e) / det(S + dilation)), as Mip-Splatting does with e = 0: a low-resolution stage uses e = dilation
    (size / 512)^2, which makes its renders match downscaled 512 px images.
    """
    return CpuScene(*check_scene(scales, colors, opacities), float(dilation), compensate)
