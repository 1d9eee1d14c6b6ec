# SPDX-License-Identifier: GPL-3.0-or-later
"""The Warp rasteriser: many images in one launch on a CUDA device, with no compiler on the user's machine.

Warp brings its own CUDA compiler. The same kernels run, one thread after the other, on Warp's "cpu" device; set
GSKIN_WARP_DEVICE=cpu for that (tests do).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from .. import batches
from ..backends import WARP_DEVICE
from ..batches import in_batches
from ..camera import Camera
from ..cpu.backend import DILATION, Array, ImageLoss, camera_vector, check_scene, check_splats
from .blend import LANES, blend, blend_backward
from .image_losses import image_losses
from .project import TILE, project, project_backward, sums6
from .tiles import find_starts, gather, list_pairs, record_t

if TYPE_CHECKING:
    from torch import Tensor

def find_device() -> Any:
    """The device that scenes are prepared on. InputError if there is none."""
    name = os.environ.get(WARP_DEVICE, "")
    if not name and not wp.is_cuda_available():
        raise InputError("The rasteriser warp cannot use the CUDA device; update NVIDIA's driver, or choose cpu.")
    return wp.get_device(name or "cuda")


@dataclass(frozen=True)
class ForwardState:
    """What a forward pass of P images stores for its backward pass, all on the device."""

    means: Any
    quats: Any
    cameras: Any
    last_slot: Any
    tiles: Any
    start: Any
    records: Any
    slots: Any
    pairs: int
    image: Any
    alpha: Any


@dataclass(frozen=True)
class WarpFrame:
    """The Frame of one image; `image` (H,W,3) and `alpha` (H,W) are fetched when they are read."""

    state: ForwardState

    @cached_property
    def image(self) -> Array:
        return self.state.image.numpy()[0]

    @cached_property
    def alpha(self) -> Array:
        return self.state.alpha.numpy()[0]


class WarpScene:
    """A scene on a Warp device; see cpu.CpuScene for its methods."""

    def __init__(
        self, scales: Array, colors: Array, opacities: Array, dilation: float, compensate: float | None
    ) -> None:
        self.count, self.dilation, self.compensate = len(scales), dilation, compensate
        self.device = find_device()
        self._scales, self._colors = self._upload(scales, wp.vec3), self._upload(colors, wp.vec3)
        self._opacities = self._upload(opacities, wp.float32)

    def forward(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        camera: Camera,
        background: ArrayLike = (1.0, 1.0, 1.0),
        *,
        colors: ArrayLike | None = None,
    ) -> WarpFrame:
        """Render means (N,3) and quats (N,4); `colors` (N,3) replaces the scene's for once."""
        c = None if colors is None else np.ascontiguousarray(colors, np.float32)
        m, q = check_splats(means, quats, c, self.count)
        own = self._colors if c is None else self._upload(c, wp.vec3)
        state = self._forward(self._upload(m, wp.vec3), self._upload(q, wp.vec4), [camera], background, own)
        return WarpFrame(state)

    def backward(
        self, frame: WarpFrame, grad_image: ArrayLike, grad_alpha: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Gradients to means (N,3) and quats (N,4) from those to the image (H,W,3) and to alpha (H,W)."""
        gi = self._upload(np.ascontiguousarray(grad_image, np.float32)[None], wp.float32)
        ga = None if grad_alpha is None else np.ascontiguousarray(grad_alpha, np.float32)[None]
        grad_means, grad_quats = self._backward(frame.state, gi, ga if ga is None else self._upload(ga, wp.float32))
        return grad_means.numpy(), grad_quats.numpy()

    def render(
        self, means: ArrayLike, quats: ArrayLike, camera: Camera, background: ArrayLike = (1.0, 1.0, 1.0)
    ) -> tuple[Array, Array]:
        """(image (H,W,3), alpha (H,W)); see forward."""
        frame = self.forward(means, quats, camera, background)
        return frame.image, frame.alpha

    def render_and_grad_many(
        self,
        means: Array,
        quats: Array,
        cameras: Sequence[Camera],
        losses: Sequence[ImageLoss],
        background: ArrayLike = (1.0, 1.0, 1.0),
    ) -> tuple[NDArray[np.float64], Array, Array]:
        """Values (P,), grad_means (P,N,3) and grad_quats (P,N,4) of P images: means (P,N,3), quats (P,N,4).

        Photometric losses are computed on the device; any other loss fetches its image.
        """
        m, q = np.ascontiguousarray(means, np.float32), np.ascontiguousarray(quats, np.float32)
        grad_means, grad_quats = np.empty(m.shape, np.float32), np.empty(q.shape, np.float32)
        values = np.zeros(len(cameras))

        def step(part: slice) -> None:
            state = self._forward(
                self._upload(m[part].reshape(-1, 3), wp.vec3), self._upload(q[part].reshape(-1, 4), wp.vec4),
                cameras[part], background, self._colors,
            )  # fmt: skip
            values[part], grad_image = image_losses(state.image, state.alpha, losses[part])
            grads = self._backward(state, grad_image, None)
            grad_means[part], grad_quats[part] = (
                g.numpy().reshape(-1, self.count, width) for g, width in zip(grads, (3, 4), strict=True)
            )

        in_batches(cameras, step)
        return values, grad_means, grad_quats

    def render_and_grad_tensors(
        self,
        means: Tensor,
        quats: Tensor,
        cameras: Sequence[Camera],
        losses: Sequence[ImageLoss],
        background: ArrayLike = (1.0, 1.0, 1.0),
    ) -> tuple[NDArray[np.float64], Tensor, Tensor]:
        """render_and_grad_many of torch tensors that are on the scene's device: nothing but values leaves it.

        Raises ValueError for tensors elsewhere, which a kernel on a GPU could not read.
        """
        import torch

        for tensor in (means, quats):
            if str(tensor.device) != self.tensor_device:
                raise ValueError(f"a tensor on {tensor.device} for a scene on {self.tensor_device}")
        m, q = means.detach().to(torch.float32).contiguous(), quats.detach().to(torch.float32).contiguous()
        grad_means, grad_quats = torch.empty_like(m), torch.empty_like(q)
        values = np.zeros(len(cameras))

        def step(part: slice) -> None:
            view = [
                wp.from_torch(t[part].view(-1, t.shape[-1]), dtype=wp.vec3 if t.shape[-1] == 3 else wp.vec4)
                for t in (m, q, grad_means, grad_quats)
            ]
            state = self._forward(view[0], view[1], cameras[part], background, self._colors)
            values[part], grad_image = image_losses(state.image, state.alpha, losses[part])
            self._backward(state, grad_image, None, (view[2], view[3]))

        # Warp and torch have streams of their own; in torch's, each sees what the other did before.
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(m.device)) if m.is_cuda else None):
            in_batches(cameras, step)
        return values, grad_means, grad_quats

    @property
    def tensor_device(self) -> str:
        """torch's name of the device that `render_and_grad_tensors` wants its tensors on."""
        return str(wp.device_to_torch(self.device))

    def contribution(self, means: ArrayLike, quats: ArrayLike, camera: Camera) -> Array:
        """Largest blending weight of each splat over the view's pixels, (N,); 0 if it is not seen."""
        m, q = check_splats(means, quats, None, self.count)
        most = wp.zeros(self.count, dtype=wp.float32, device=self.device)
        self._forward(
            self._upload(m, wp.vec3), self._upload(q, wp.vec4), [camera], (0.0, 0.0, 0.0), self._colors, most
        )
        return most.numpy()

    def _upload(self, array: NDArray[Any], dtype: Any) -> Any:
        return wp.array(array, dtype=dtype, device=self.device)

    def _empty(self, count: int | tuple[int, ...], dtype: Any) -> Any:
        return wp.empty(count, dtype=dtype, device=self.device)

    def _forward(
        self,
        means: Any,
        quats: Any,
        cameras: Sequence[Camera],
        background: ArrayLike,
        colors: Any,
        most: Any = None,
    ) -> ForwardState:
        """Images of P cameras of one size from means and quats (P*N,) on the device."""
        n, poses = self.count, len(cameras)
        height, width = cameras[0].size
        columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
        vectors = np.stack([camera_vector(camera, self.dilation, self.compensate) for camera in cameras])
        views = self._upload(vectors, wp.float64)
        total, tile_count = poses * n, poses * columns * rows
        pixels, conic, rect = self._empty(total, wp.vec2d), self._empty(total, wp.vec4), self._empty(total, wp.vec4i)
        reach, depth = self._empty(total, wp.float32), self._empty(total, wp.float32)
        tiles, last_slot = self._empty(total, wp.int64), self._empty(total, wp.int64)
        self._launch(
            project, total,
            [n, means, quats, self._scales, self._opacities, views, width, height],
            [pixels, conic, reach, depth, rect, tiles],
        )  # fmt: skip
        pairs = 0
        if total:
            wp.utils.array_scan(tiles, last_slot, inclusive=True)
            pairs = int(last_slot[total - 1 :].numpy()[0])
        if pairs > batches.PAIRS_AT_ONCE and (poses > 1 or pairs >= 2**30):
            raise batches.TooManyPairs
        keys, slots = self._empty(2 * pairs, wp.int64), self._empty(2 * pairs, wp.int32)  # the sort wants twice
        owner, records = self._empty(pairs, wp.int32), self._empty(pairs, record_t)
        start = wp.zeros(tile_count + 1, dtype=wp.int32, device=self.device)
        if pairs:
            self._launch(
                list_pairs, total, [n, columns, rows, rect, tiles, last_slot, depth], [keys, slots, owner]
            )
            wp.utils.radix_sort_pairs(keys, slots, pairs, end_bit=32 + tile_count.bit_length())
            self._launch(find_starts, tile_count + 1, [pairs, keys], [start])
            self._launch(
                gather, pairs, [n, columns, rows, keys, slots, owner, pixels, conic, reach, colors], [records]
            )
        shape = poses, height, width
        image, alpha = self._empty((*shape, 3), wp.float32), self._empty(shape, wp.float32)
        if most is None:
            most = self._empty(0, wp.float32)
        self._launch(
            blend, tile_count * LANES,
            [columns, rows, width, height, start, records, wp.vec3(*map(float, np.asarray(background))), slots, owner],
            [image, alpha, most],
        )  # fmt: skip
        return ForwardState(means, quats, views, last_slot, tiles, start, records, slots, pairs, image, alpha)

    def _backward(self, state: ForwardState, grad_image: Any, grad_alpha: Any, out: Any = None) -> tuple[Any, Any]:
        """Gradients (P*N,) on the device; written to `out` where given."""
        poses, height, width, _ = state.image.shape
        columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
        total = poses * self.count
        partial = wp.zeros(state.pairs, dtype=sums6, device=self.device)
        if grad_alpha is None:
            grad_alpha = self._empty((0, 0, 0), wp.float32)
        self._launch(
            blend_backward, poses * columns * rows * LANES,
            [columns, rows, width, height, state.start, state.records, state.slots, state.image, state.alpha,
             grad_image, grad_alpha],
            [partial],
        )  # fmt: skip
        grads = out or (self._empty(total, wp.vec3), self._empty(total, wp.vec4))
        self._launch(
            project_backward, total,
            [self.count, state.means, state.quats, self._scales, state.cameras, state.last_slot, state.tiles, partial],
            list(grads),
        )  # fmt: skip
        return grads[0], grads[1]

    def _launch(self, kernel: Any, threads: int, inputs: list[Any], outputs: list[Any]) -> None:
        # 128 threads are four whole warps, so a tile's 32 threads are one warp's lanes.
        wp.launch(kernel, threads, inputs=inputs, outputs=outputs, device=self.device, block_dim=128)


def prepare(
    scales: ArrayLike,
    colors: ArrayLike,
    opacities: ArrayLike,
    *,
    dilation: float = DILATION,
    compensate: float | None = None,
) -> WarpScene:
    """A scene on the GPU; the same arguments and meaning as cpu.prepare."""
    return WarpScene(*check_scene(scales, colors, opacities), float(dilation), compensate)
