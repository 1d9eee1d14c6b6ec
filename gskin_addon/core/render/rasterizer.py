# SPDX-License-Identifier: GPL-3.0-or-later
"""The one way to render splats: backends by name, and pictures of clouds."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..splats.cloud import SplatCloud
from ..splats.sh import eval_sh
from . import fragments
from .backends import BACKENDS, resolve_backend
from .camera import Camera

Array = NDArray[np.float32]


class Scene(Protocol):
    """What a backend prepares from the constant parts of splats; cpu.CpuScene has the methods' contracts."""

    def forward(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        camera: Camera,
        background: ArrayLike = ...,
        *,
        colors: ArrayLike | None = None,
    ) -> Any:
        """A frame with `.image` (H,W,3) and `.alpha` (H,W), to be given to `backward`."""

    def backward(self, frame: Any, grad_image: ArrayLike, grad_alpha: ArrayLike | None = None) -> tuple[Array, Array]:
        """Gradients to means (N,3) and quats (N,4)."""

    def render_and_grad_many(
        self,
        means: Array,
        quats: Array,
        cameras: Sequence[Camera],
        losses: Sequence[Any],
        background: ArrayLike = ...,
    ) -> tuple[NDArray[np.float64], Array, Array]:
        """Loss values (P,) of P images and gradients to means (P,N,3) and quats (P,N,4)."""

    def contribution(self, means: ArrayLike, quats: ArrayLike, camera: Camera) -> Array:
        """Largest blending weight of each splat, (N,)."""


def prepare(
    scales: ArrayLike,
    colors: ArrayLike,
    opacities: ArrayLike,
    *,
    backend: str = "auto",
    dilation: float = 0.3,
    compensate: float | None = None,
) -> Scene:
    """A scene for many renders of moving splats: scales and colors (N,3), opacities (N,); see cpu.prepare."""
    module = import_module(BACKENDS[resolve_backend(backend)].module, __package__)
    scene: Scene = module.prepare(scales, colors, opacities, dilation=dilation, compensate=compensate)
    return scene


def has_to_compile() -> bool:
    """Whether the first picture of `render_cloud` waits until the CPU's kernels are compiled, which is kept."""
    if importlib.util.find_spec("numba") is None:
        return False
    from .cpu import blend, compiled

    return not compiled.is_compiled(blend.forward_tiles)


def view_colors(cloud: SplatCloud, camera: Camera) -> Array:
    """Colours (N,3) of the splats as the camera sees them: SH along the direction from it to each mean."""
    rays = cloud.means - camera.center.astype(np.float32)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    return np.ascontiguousarray(eval_sh(cloud.sh, rays), np.float32)


def render_cloud(
    cloud: SplatCloud, camera: Camera, background: ArrayLike = (1.0, 1.0, 1.0), backend: str = "cpu"
) -> tuple[Array, Array]:
    """Picture of a cloud: image (H,W,3) in 0..1 sRGB over `background` (3,), and alpha (H,W), float32.

    By the CPU unless asked otherwise: for one picture it is done before a GPU has begun. In numpy where this Python has
    no numba.
    """
    if backend == "cpu" and importlib.util.find_spec("numba") is None:
        parts = cloud.means, cloud.quats, cloud.scales, view_colors(cloud, camera), cloud.opacities
        picture = fragments.draw(*parts, camera)
        red, green, blue = np.asarray(background, np.float32).tolist()
        return picture.over((red, green, blue)), picture.alpha
    scene = prepare(cloud.scales, view_colors(cloud, camera), cloud.opacities, backend=backend)
    frame = scene.forward(cloud.means, cloud.quats, camera, background)
    return np.clip(frame.image, 0.0, 1.0), frame.alpha
