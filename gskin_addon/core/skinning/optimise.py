# SPDX-License-Identifier: GPL-3.0-or-later
"""Learning the weights from guidance images (Eq. 9): rendering loss + ARAP + coupling, by Adam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..render.backends import AUTO, resolve_backend
from ..render.camera import Camera
from ..render.cpu import DILATION
from ..render.photometric import Box, PhotometricLoss, content_box, photometric_loss
from ..render.rasterizer import Scene, prepare, view_colors
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from .arap import arap_loss
from .coupling import coupling_loss, prepare_coupling
from .fields.base import WeightField
from .on_device import DeviceRenderer, Views, tensor_device
from .posers import Poser, SplatPoser
from .presets import Preset

ARAP_NODES = 2000


@dataclass(frozen=True)
class Target:
    """A guidance image: what the splats should look like in one pose from one camera.

    transforms (B, 4, 4); image (H, W, 3) uint8 sRGB at the camera's size.
    """

    camera: Camera
    transforms: NDArray[np.float64]
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class LossWeights:
    """Factors of Eq. 9. ARAP is counted relative to the mean squared edge, coupling in the unit diagonal.

    Both are thereby free of the asset's scale; the paper does not state its w_a and w_c.
    """

    arap: float = 0.02
    coupling: float = 20.0
    dssim: float = 0.2


class Optimiser:
    """Adam on a weight field; keeps what is needed to stop and go on.

    `poser` says how weights move the splats (default: each splat by its own); the field gives the weights of its
    nodes. The cloud, the skeleton and the targets must be in the same coordinates, the object near unit size
    (bounding-box diagonal 1), so that the loss weights mean the same for every asset.
    """

    def __init__(
        self,
        cloud: SplatCloud,
        skeleton: Skeleton,
        field: WeightField,
        targets: Sequence[Target],
        preset: Preset,
        *,
        poser: Poser | None = None,
        losses: LossWeights = LossWeights(),
        seed: int = 0,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        rasterizer: str = AUTO,
    ) -> None:
        self.field, self.targets, self.preset, self.losses = field, targets, preset, losses
        self.iteration = 0
        self._cloud, self._background = cloud, background
        self._rng = np.random.default_rng(seed)
        self._queue: list[int] = []
        self._rate = preset.learning_rate * field.rate
        self._adam = torch.optim.Adam(field.parameters(), lr=self._rate, betas=(0.9, 0.99))
        self._poser: Poser = poser or SplatPoser(cloud)
        nodes, self._neighbours = self._poser.nodes, self._poser.neighbours
        self._nodes = torch.from_numpy(nodes)
        self._scenes: dict[tuple[bytes, int], Scene] = {}
        self._boxes: dict[tuple[int, int], Box] = {}
        self.rasterizer = resolve_backend(rasterizer)
        self._kept_losses: dict[tuple[int, int], PhotometricLoss] = {}
        self._on_device = self._device_renderer()
        self._coupling = prepare_coupling(nodes, skeleton)
        step = max(1, len(nodes) // 5000)
        edges = nodes[self._neighbours[::step]] - nodes[::step, None]
        self._edge_square = float(np.square(edges).sum(-1).mean()) + 1e-12

    def step(self) -> dict[str, float]:
        """One iteration on the next batch; returns the parts of the loss."""
        size = self._size_now()
        for group in self._adam.param_groups:
            group["lr"] = self._rate * self._decay()
        batch = [self._next_target() for _ in range(min(self.preset.batch, len(self.targets)))]
        transforms = np.stack([self.targets[i].transforms for i in batch])
        weights = self.field()
        if self._on_device is not None:
            render, nodes = self._on_device(weights, transforms, self._views(batch, size))
        else:
            posed = self._poser.pose(weights, transforms)
            nodes = posed.nodes
            render = _Render.apply(posed.means, posed.quats, self, batch, size)  # type: ignore[no-untyped-call]
        coupling = coupling_loss(self._coupling, nodes, transforms)
        arap = self._arap(nodes)
        loss = render + self.losses.arap * arap + self.losses.coupling * coupling
        self._adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._adam.step()
        self.iteration += 1
        return {
            name: float(part.detach())
            for name, part in (("render", render), ("arap", arap), ("coupling", coupling))
        }

    def weights(self) -> NDArray[np.float32]:
        """The present weights of the poser's nodes (M, B), rows sum to 1."""
        with torch.no_grad():
            return self.field().numpy()

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs to go on exactly where this stands."""
        return {
            "iteration": self.iteration,
            "queue": list(self._queue),
            "rng": self._rng.bit_generator.state,
            "field": self.field.state_dict(),
            "adam": self._adam.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state` of an optimiser with the same inputs."""
        self.field.load_state_dict(state["field"])
        self._adam.load_state_dict(state["adam"])
        self._rng.bit_generator.state = state["rng"]
        self._queue = list(state["queue"])
        self.iteration = int(state["iteration"])

    def _size_now(self) -> int:
        passed = 0
        for size, iterations in self.preset.stages:
            passed += iterations
            if self.iteration < passed:
                return size
        return self.preset.stages[-1][0]

    def _decay(self) -> float:
        """Cosine from 1 to 0.1: early steps are large, the last ones settle."""
        part = self.iteration / max(self.preset.iterations, 1)
        return 0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * min(part, 1.0)))

    def _next_target(self) -> int:
        if not self._queue:
            self._queue = self._rng.permutation(len(self.targets)).tolist()
        return self._queue.pop()

    def render_and_grad(
        self, means: NDArray[np.float32], quats: NDArray[np.float32], batch: Sequence[int], size: int
    ) -> tuple[float, NDArray[np.float32], NDArray[np.float32]]:
        """Mean photometric loss of the targets `batch`, with its gradients to means (P, N, 3), quats (P, N, 4).

        Targets that share a scene (all, for splats without view-dependent colour) are rendered side by side.
        """
        total = 0.0
        grad_means, grad_quats = np.empty_like(means), np.empty_like(quats)
        for views in self._views(batch, size):
            values, grad_means[views.slots], grad_quats[views.slots] = views.scene.render_and_grad_many(
                means[views.slots], quats[views.slots], views.cameras, views.losses, self._background
            )
            total += float(values.sum())
        count = len(batch)
        return total / count, grad_means / count, grad_quats / count

    def _views(self, batch: Sequence[int], size: int) -> list[Views]:
        """The targets `batch` by the scene that they share."""
        found: dict[int, Views] = {}
        for slot, index in enumerate(batch):
            camera = self.targets[index].camera
            scene = self._scene(camera, size)
            views = found.setdefault(id(scene), Views(scene, [], [], []))
            views.slots.append(slot)
            views.cameras.append(camera.resized(size))
            views.losses.append(self._loss(index, size))
        return list(found.values())

    def _device_renderer(self) -> DeviceRenderer | None:
        """For vanilla splats and a rasteriser that takes torch tensors."""
        if self.rasterizer == "cpu" or not self.targets or not isinstance(self._poser, SplatPoser):
            return None
        device = tensor_device(self._scene(self.targets[0].camera, self._size_now()))
        return None if device is None else DeviceRenderer(self._cloud, device, self._background)

    def _scene(self, camera: Camera, size: int) -> Scene:
        """The splats as seen in rest pose by a camera; their colours are constants of the optimisation."""
        key = (b"" if self._cloud.sh_degree == 0 else camera.center.tobytes(), size)
        if key not in self._scenes:
            cloud, full = self._cloud, camera.height
            # Small renders would be blurrier than averaged guidance: correct the opacity for the filter.
            compensate = None if size == full else DILATION * (size / full) ** 2
            self._scenes[key] = prepare(
                cloud.scales,
                view_colors(cloud, camera),
                cloud.opacities,
                compensate=compensate,
                backend=self.rasterizer,
            )
        return self._scenes[key]

    def _loss(self, index: int, size: int) -> PhotometricLoss:
        """The loss of a guidance image; kept while `size` lasts where its image stays on a device with it."""
        if self._on_device is None:
            return self._make_loss(index, size)
        key = (index, size)
        if key not in self._kept_losses:
            self._kept_losses = {k: loss for k, loss in self._kept_losses.items() if k[1] == size}
            self._kept_losses[key] = self._make_loss(index, size)
        return self._kept_losses[key]

    def _make_loss(self, index: int, size: int) -> PhotometricLoss:
        """The photometric loss of a guidance image, box-averaged where it was made larger than `size`."""
        image: NDArray[Any] = self.targets[index].image
        factor = image.shape[0] // size
        if factor > 1:
            blocks = image.reshape(size, factor, size, factor, 3).astype(np.float32)
            image = blocks.mean(axis=(1, 3)) / np.float32(255)
        key = (index, size)
        if key not in self._boxes:
            self._boxes[key] = content_box(self._differs(image))
        return photometric_loss(image, self._background, weight=self.losses.dssim, box=self._boxes[key])

    def _differs(self, image: NDArray[Any]) -> NDArray[np.bool_]:
        """Pixels (H, W) of an image that are not bare background."""
        unit = 255.0 if image.dtype == np.uint8 else 1.0
        background = np.asarray(self._background) * unit
        return (np.abs(image - background) > 1e-4 * unit).any(axis=-1)

    def _arap(self, posed: torch.Tensor) -> torch.Tensor:
        count = posed.shape[1]
        nodes = self._rng.choice(count, min(ARAP_NODES, count), replace=False)
        near = self._neighbours[nodes]
        result: torch.Tensor = _Arap.apply(posed, self._nodes, nodes, near)  # type: ignore[no-untyped-call]
        return result / self._edge_square


class _Arap(torch.autograd.Function):
    @staticmethod
    def forward(ctx, posed, rest, nodes, neighbours):  # type: ignore[no-untyped-def]
        value, grad = arap_loss(rest.numpy(), posed.detach().numpy(), nodes, neighbours)
        ctx.grad = torch.from_numpy(grad)
        return torch.tensor(value, dtype=posed.dtype)

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return ctx.grad * grad, None, None, None


class _Render(torch.autograd.Function):
    """The rendering loss as one node: value and gradients come from the rasteriser together."""

    @staticmethod
    def forward(ctx, means, quats, optimiser, batch, size):  # type: ignore[no-untyped-def]
        value, *grads = optimiser.render_and_grad(means.detach().numpy(), quats.detach().numpy(), batch, size)
        ctx.grads = [torch.from_numpy(grad) for grad in grads]
        return torch.tensor(value, dtype=means.dtype)

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return ctx.grads[0] * grad, ctx.grads[1] * grad, None, None, None
