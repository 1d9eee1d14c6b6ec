# SPDX-License-Identifier: GPL-3.0-or-later
"""gsplat (Apache-2.0, 1.5) as a rasteriser, where it is installed and its CUDA kernels are compiled.

Its conventions are ours (wxyz, OpenCV cameras, dilation, slope bounds) but for two: it lets alpha reach 0.999 where
we stop at 0.99, so opacities are cut at 0.99 first; and its own compensation is only our `compensate` = 0, so the
opacities are compensated here, by torch, which carries the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from .batches import in_batches
from .camera import Camera
from .cpu import backend as cpu
from .cpu.backend import DILATION, Array, ImageLoss, check_scene, check_splats
from .photometric import PhotometricLoss
from .reference import image_axes
from .torch_loss import photometric_losses

ALPHA_MAX = 0.99


@dataclass(frozen=True)
class GsplatFrame:
    """The Frame of one image, with torch's graph behind it."""

    tensors: tuple[Tensor, Tensor]
    leaves: tuple[Tensor, Tensor]

    @cached_property
    def image(self) -> Array:
        return self.tensors[0].detach().cpu().numpy()

    @cached_property
    def alpha(self) -> Array:
        return self.tensors[1].detach().cpu().numpy()


class GsplatScene:
    """A scene drawn by `rasterization` (gsplat's signature) on a torch device; see cpu.CpuScene for the methods."""

    def __init__(
        self,
        scales: Array,
        colors: Array,
        opacities: Array,
        dilation: float,
        compensate: float | None,
        rasterization: Callable[..., Any],
        device: str,
    ) -> None:
        self.dilation, self.compensate, self.tensor_device = dilation, compensate, device
        self._arrays, self._rasterization = (scales, colors, opacities), rasterization
        self._scales, self._colors, self._opacities = (
            torch.from_numpy(a).to(device) for a in (scales, colors, opacities)
        )

    def forward(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        camera: Camera,
        background: ArrayLike = (1.0, 1.0, 1.0),
        *,
        colors: ArrayLike | None = None,
    ) -> GsplatFrame:
        """Render means (N,3) and quats (N,4); `colors` (N,3) replaces the scene's for once."""
        c = None if colors is None else np.ascontiguousarray(colors, np.float32)
        m, q = (self._leaf(a) for a in check_splats(means, quats, c, len(self._scales)))
        own = self._colors if c is None else torch.from_numpy(c).to(self.tensor_device)
        image, alpha = self._images(m[None], q[None], [camera], background, own)
        return GsplatFrame((image[0], alpha[0]), (m, q))

    def backward(
        self, frame: GsplatFrame, grad_image: ArrayLike, grad_alpha: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Gradients to means (N,3) and quats (N,4) from those to the image (H,W,3) and to alpha (H,W)."""
        image, alpha = frame.tensors
        grads = [torch.as_tensor(np.asarray(grad_image, np.float32), device=image.device)]
        if grad_alpha is not None:
            grads.append(torch.as_tensor(np.asarray(grad_alpha, np.float32), device=image.device))
        found = torch.autograd.grad([image, alpha][: len(grads)], frame.leaves, grads, retain_graph=True)
        return found[0].cpu().numpy(), found[1].cpu().numpy()

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
        """Values (P,), grad_means (P,N,3) and grad_quats (P,N,4) of P images: means (P,N,3), quats (P,N,4)."""
        m, q = (torch.as_tensor(np.asarray(a, np.float32), device=self.tensor_device) for a in (means, quats))
        values, *grads = self.render_and_grad_tensors(m, q, cameras, losses, background)
        return values, grads[0].cpu().numpy(), grads[1].cpu().numpy()

    def render_and_grad_tensors(
        self,
        means: Tensor,
        quats: Tensor,
        cameras: Sequence[Camera],
        losses: Sequence[ImageLoss],
        background: ArrayLike = (1.0, 1.0, 1.0),
    ) -> tuple[NDArray[np.float64], Tensor, Tensor]:
        """render_and_grad_many of torch tensors on `tensor_device`: nothing but values leaves it."""
        values = np.zeros(len(cameras))
        grad_means, grad_quats = torch.empty_like(means), torch.empty_like(quats)

        def step(part: slice) -> None:
            with torch.enable_grad():
                m, q = (t[part].detach().float().requires_grad_() for t in (means, quats))
                image, alpha = self._images(m, q, cameras[part], background, self._colors)
                values[part], grad = _values(image, alpha, losses[part])
                grad_means[part], grad_quats[part] = torch.autograd.grad(image, (m, q), grad)

        in_batches(cameras, step)
        return values, grad_means, grad_quats

    def contribution(self, means: ArrayLike, quats: ArrayLike, camera: Camera) -> Array:
        """Largest blending weight of each splat over the view's pixels, (N,); the CPU's, gsplat has none."""
        scene = cpu.prepare(*self._arrays, dilation=self.dilation, compensate=self.compensate)
        return scene.contribution(means, quats, camera)

    def _leaf(self, array: Array) -> Tensor:
        return torch.from_numpy(array).to(self.tensor_device).requires_grad_()

    def _images(
        self, means: Tensor, quats: Tensor, cameras: Sequence[Camera], background: ArrayLike, colors: Tensor
    ) -> tuple[Tensor, Tensor]:
        """(images (P,H,W,3), alphas (P,H,W)) of means (P,N,3) and quats (P,N,4) from P cameras of one size."""
        poses = len(cameras)
        height, width = cameras[0].size
        views, intrinsics = np.tile(np.eye(4), (poses, 1, 1, 1)), np.tile(np.eye(3), (poses, 1, 1, 1))
        for p, camera in enumerate(cameras):
            views[p, 0, :3, :3], views[p, 0, :3, 3] = camera.rotation, camera.translation
            intrinsics[p, 0, :2] = (camera.fx, 0, camera.cx), (0, camera.fy, camera.cy)
        back = np.broadcast_to(np.asarray(background, np.float32), (poses, 1, 3))
        images, alphas, _ = self._rasterization(
            means=means,
            quats=quats,
            scales=self._scales.expand(poses, -1, -1),
            opacities=torch.stack([self._opacity(*e) for e in zip(means, quats, cameras, strict=True)]),
            colors=colors.expand(poses, -1, -1),
            viewmats=means.new_tensor(views),
            Ks=means.new_tensor(intrinsics),
            width=width,
            height=height,
            near_plane=cameras[0].near,
            eps2d=self.dilation,
            backgrounds=means.new_tensor(back.copy()),
            packed=False,
            rasterize_mode="classic",
        )
        return images[:, 0], alphas[:, 0, ..., 0]

    def _opacity(self, means: Tensor, quats: Tensor, camera: Camera) -> Tensor:
        """Opacities (N,) of one view, compensated for the filter; no more than alpha may be."""
        opacity = self._opacities
        if self.compensate is not None:
            U = image_axes(means, quats, self._scales, camera)[2]
            wanted, drawn = (_determinant(U, e) for e in (self.compensate, self.dilation))
            ratio = torch.sqrt(wanted / drawn)
            opacity = opacity * torch.where(ratio.isfinite(), ratio, torch.zeros_like(ratio))
        return opacity.clamp(max=ALPHA_MAX)


def _determinant(U: Tensor, dilation: float) -> Tensor:
    """det(U U^T + dilation) (N,) of U (N,2,3), as a sum without cancellation."""
    minors = torch.linalg.cross(U[:, 0], U[:, 1]).square().sum(-1)
    return minors + dilation * U.square().sum((1, 2)) + dilation**2


def _values(image: Tensor, alpha: Tensor, losses: Sequence[ImageLoss]) -> tuple[NDArray[np.float64], Tensor]:
    """Values (P,) and the gradient to the images (P,H,W,3)."""
    known = [loss for loss in losses if isinstance(loss, PhotometricLoss)]
    if len(known) == len(losses):
        for loss in known:
            loss.check(tuple(image.shape[1:]))
        leaf = image.detach().requires_grad_()
        values = photometric_losses(leaf, known)
        return values.detach().cpu().numpy().astype(np.float64), torch.autograd.grad(values.sum(), leaf)[0]
    arrays = zip(losses, image.detach().cpu().numpy(), alpha.detach().cpu().numpy(), strict=True)
    pairs = [loss(*view) for loss, *view in arrays]
    grads = np.stack([np.asarray(grad, np.float32) for _, grad in pairs])
    return np.array([value for value, _ in pairs], np.float64), torch.as_tensor(grads, device=image.device)


def prepare(
    scales: ArrayLike,
    colors: ArrayLike,
    opacities: ArrayLike,
    *,
    dilation: float = DILATION,
    compensate: float | None = None,
) -> GsplatScene:
    """A scene on the GPU; the same arguments and meaning as cpu.prepare."""
    from gsplat import rasterization

    constant = check_scene(scales, colors, opacities)
    return GsplatScene(*constant, float(dilation), compensate, rasterization, "cuda")
