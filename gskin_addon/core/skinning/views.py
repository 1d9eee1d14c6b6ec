# SPDX-License-Identifier: GPL-3.0-or-later
"""Comparison of renders with the guidance images: one scene per view, without the hidden splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render.backends import AUTO
from ..render.camera import Camera
from ..render.cpu.backend import DILATION, CpuScene, render_and_grad_each
from ..render.photometric import PhotometricLoss, content_box, photometric_loss
from ..render.rasterizer import Scene, prepare, view_colors
from ..splats.cloud import SplatCloud
from .device_renderer import Views

Array = NDArray[np.float32]

VISIBLE_WEIGHT = 0.005
"""Blending weight that a splat must reach in a view, at `VISIBILITY_SIZE` px, to be rendered in it: about 0.01 at
512 px.

On a synthetic figure (20,000 splats, 40 iterations) 0.01 raises the final error of the weights by 1.0 to 1.3 %, this
value by 0.2 to 0.7 %."""
VISIBILITY_SIZE = 256
"""Side in pixels of the renders that find the visible splats."""
_CHUNK = 8


@dataclass(frozen=True)
class Target:
    """A guidance image: what the splats should look like in one pose from one camera.

    transforms (B, 4, 4); image (H, W, 3) uint8 sRGB at the camera's size.
    """

    camera: Camera
    transforms: NDArray[np.float64]
    image: NDArray[np.uint8]


class GuidanceViews:
    """Renders of one cloud against targets; a view is all targets of one camera."""

    def __init__(
        self,
        cloud: SplatCloud,
        targets: Sequence[Target],
        *,
        dssim: float,
        background: tuple[float, float, float],
        backend: str = AUTO,
    ) -> None:
        self.targets = targets
        self._cloud, self._dssim, self._background, self._backend = cloud, dssim, background, backend
        keys = [t.camera.rotation.tobytes() + t.camera.translation.tobytes() for t in targets]
        order = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        self.view = [order[key] for key in keys]
        self.visible: list[NDArray[np.bool_] | None] = [None] * len(order)
        self._scenes: dict[tuple[int, int, bool], Scene] = {}
        self._losses: dict[tuple[int, int], PhotometricLoss] = {}

    def render_and_grad(
        self, means: Array, quats: Array, batch: Sequence[int], size: int
    ) -> tuple[float, Array, Array]:
        """Mean photometric loss of the targets `batch` at `size` px, and its gradients to means (P, N, 3) and
        quats (P, N, 4); zero for splats that the target's view does not see."""
        slots = range(len(batch))
        scenes = [self.scene(index, size) for index in batch]
        keep = [self.visible[self.view[index]] for index in batch]
        parts = [
            (means[p], quats[p]) if k is None else (means[p, k], quats[p, k])
            for p, k in zip(slots, keep, strict=True)
        ]
        cameras = [self.targets[index].camera.resized(size) for index in batch]
        losses = [self._loss(index, size) for index in batch]
        values, *grads = _render_all(scenes, parts, cameras, losses, self._background)
        grad_means, grad_quats = np.zeros_like(means), np.zeros_like(quats)
        for p, k in zip(slots, keep, strict=True):
            rows: Any = slice(None) if k is None else k
            grad_means[p, rows], grad_quats[p, rows] = grads[0][p], grads[1][p]
        count = np.float32(len(batch))
        grad_means /= count
        grad_quats /= count
        return float(values.sum()) / len(batch), grad_means, grad_quats

    def loss(self, means: Array, quats: Array, index: int, size: int) -> float:
        """Photometric loss of one target for means (N, 3), quats (N, 4), all splats rendered."""
        scene = self.scene(index, size, whole=True)
        frame = scene.forward(means, quats, self.targets[index].camera.resized(size), self._background)
        return self._loss(index, size)(frame.image, frame.alpha)[0]

    def update_visible(self, pose: Callable[[NDArray[np.float64]], tuple[Array, Array]], size: int) -> None:
        """Find out again which splats each view sees in any of its poses.

        pose: transforms (P, B, 4, 4) -> means (P, N, 3), quats (P, N, 4) with the current weights.
        """
        size = min(size, VISIBILITY_SIZE)
        most = np.zeros((len(self.visible), self._cloud.count), np.float32)
        for first in range(0, len(self.targets), _CHUNK):
            chunk = range(first, min(first + _CHUNK, len(self.targets)))
            means, quats = pose(np.stack([self.targets[index].transforms for index in chunk]))
            for m, q, index in zip(means, quats, chunk, strict=True):
                scene = self.scene(index, size, whole=True)
                weight = scene.contribution(m, q, self.targets[index].camera.resized(size))
                view = self.view[index]
                np.maximum(most[view], weight, out=most[view])
        self.set_visible(list(most > VISIBLE_WEIGHT))

    def set_visible(self, visible: Sequence[NDArray[np.bool_] | None]) -> None:
        """Take masks (N,) for the views; None renders all splats."""
        self.visible = [None if mask is None or mask.all() else mask for mask in visible]
        self._scenes = {key: scene for key, scene in self._scenes.items() if key[2]}

    def by_scene(self, batch: Sequence[int], size: int) -> list[Views]:
        """The targets `batch` by the scene that they share; with all splats, the hidden ones too."""
        found: dict[int, Views] = {}
        for slot, index in enumerate(batch):
            scene = self.scene(index, size, whole=True)
            views = found.setdefault(id(scene), Views(scene, [], [], []))
            views.slots.append(slot)
            views.cameras.append(self.targets[index].camera.resized(size))
            views.losses.append(self._loss(index, size))
        return list(found.values())

    def scene(self, index: int, size: int, *, whole: bool = False) -> Scene:
        """The splats as a target's camera sees them at rest; their colours are constants of the optimisation."""
        view = self.view[index]
        mask = None if whole else self.visible[view]
        cloud, camera = self._cloud, self.targets[index].camera
        flat = mask is None and cloud.sh_degree == 0  # the same from everywhere
        key = (-1 if flat else view, size, mask is None)
        if key not in self._scenes:
            part = cloud if mask is None else cloud.select(mask)
            full = camera.height
            # Small renders would be blurrier than averaged guidance: correct the opacity for the filter.
            compensate = None if size == full else DILATION * (size / full) ** 2
            self._scenes[key] = prepare(
                part.scales,
                view_colors(part, camera),
                part.opacities,
                compensate=compensate,
                backend=self._backend,
            )
        return self._scenes[key]

    def _loss(self, index: int, size: int) -> PhotometricLoss:
        """The loss of a guidance image, cached while `size` stays the same."""
        key = (index, size)
        if key not in self._losses:
            self._losses = {k: loss for k, loss in self._losses.items() if k[1] == size}
            image = self.targets[index].image
            image = image if image.shape[0] <= size else shrink(image, size)
            bare = np.asarray(self._background) * 255.0
            box = content_box((np.abs(image - bare) > 0.1).any(axis=-1))
            self._losses[key] = photometric_loss(image, self._background, weight=self._dssim, box=box)
        return self._losses[key]


def shrink(image: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """An image (H, H, 3) at `size` px, as blurred as a render of that size.

    Both renders add `DILATION` px^2 of their own pixels to every splat, so the smaller one is wider by the
    difference; an average over blocks would be sharper than it, and learning from that is biased.
    """
    blur = _shrinking(image.shape[0], size)
    rows = (blur @ image.reshape(image.shape[0], -1).astype(np.float32)).reshape(size, image.shape[0], 3)
    small = blur @ rows.transpose(1, 0, 2).reshape(image.shape[0], -1)
    return (small.reshape(size, size, 3).transpose(1, 0, 2) + 0.5).astype(np.uint8)


@lru_cache(maxsize=8)
def _shrinking(full: int, size: int) -> Any:
    """Sparse matrix (size, full) of Gaussian weights that takes a line of pixels to fewer ones."""
    from scipy import sparse

    factor = full / size
    variance = DILATION * (factor**2 - 1)
    centre = (np.arange(size) + 0.5) * factor
    reach = int(np.ceil(3 * np.sqrt(variance))) + 1
    column = np.floor(centre).astype(int)[:, None] + np.arange(-reach, reach + 1)
    weight = np.exp(-0.5 * (column + 0.5 - centre[:, None]) ** 2 / variance)
    column = np.clip(column, 0, full - 1)
    weight /= weight.sum(axis=1, keepdims=True)
    row = np.repeat(np.arange(size), column.shape[1])
    return sparse.csr_matrix((weight.ravel().astype(np.float32), (row, column.ravel())), shape=(size, full))


def _render_all(
    scenes: Sequence[Scene],
    parts: Sequence[tuple[Array, Array]],
    cameras: Sequence[Camera],
    losses: Sequence[PhotometricLoss],
    background: tuple[float, float, float],
) -> tuple[NDArray[np.float64], list[Array], list[Array]]:
    """Values and gradients of P images; images of one scene go to its backend together."""
    on_cpu = [scene for scene in scenes if isinstance(scene, CpuScene)]
    means, quats = [part[0] for part in parts], [part[1] for part in parts]
    if len(on_cpu) == len(scenes):
        return render_and_grad_each(on_cpu, means, quats, cameras, losses, background)
    values = np.zeros(len(scenes))
    grads: tuple[list[Any], list[Any]] = ([None] * len(scenes), [None] * len(scenes))
    groups: dict[int, list[int]] = {}
    for slot, scene in enumerate(scenes):
        groups.setdefault(id(scene), []).append(slot)
    for slots in groups.values():
        values[slots], many_means, many_quats = scenes[slots[0]].render_and_grad_many(
            np.stack([means[s] for s in slots]),
            np.stack([quats[s] for s in slots]),
            [cameras[s] for s in slots],
            [losses[s] for s in slots],
            background,
        )
        for slot, grad_means, grad_quats in zip(slots, many_means, many_quats, strict=True):
            grads[0][slot], grads[1][slot] = grad_means, grad_quats
    return values, *grads
