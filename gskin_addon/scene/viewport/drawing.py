# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats into a target of our own, blended in sRGB; and whole pictures of them off screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.render.drawn_splats import DrawnSplats
from ...core.render.screen_space import is_orthographic
from ...core.render.view_order import arrange
from .shaders import gpu_state, gpu_types, splat_shader, square
from .textures import PoseTextures, color_texture, image_texture, object_texture, order_texture, pose_textures


@dataclass(frozen=True)
class Target:
    """A framebuffer of RGBA16F: premultiplied sRGB and alpha."""

    texture: Any
    framebuffer: Any
    width: int
    height: int


def make_target(width: int, height: int) -> Target:
    """A target of so many pixels."""
    texture = gpu_types.GPUTexture((width, height), format="RGBA16F")
    return Target(texture, gpu_types.GPUFrameBuffer(color_slots=[texture]), width, height)


def draw_into(
    target: Target,
    pose: PoseTextures,
    matrices: Sequence[NDArray[Any]],
    order: Any,
    colors: Any,
    view: ArrayLike,
    projection: ArrayLike,
    *,
    count: int | None = None,
    depths: Any = None,
) -> None:
    """Clear the target and draw splats into it, in the order given; Blender's GPU state is as before afterwards.

    matrices: each object's space to the world (4, 4); order, colors: textures of `order_texture`, `color_texture`;
    count: of splats in the order (default all); depths: R32F, 0 near to 1 far, of what may hide splats.
    """
    V, P = np.asarray(view, np.float64), np.asarray(projection, np.float64)
    shader = splat_shader(behind_others=depths is not None)
    objects = object_texture([V @ matrix for matrix in matrices])
    before = gpu_state.blend_get(), gpu_state.depth_test_get(), gpu_state.depth_mask_get(), gpu_state.viewport_get()
    with target.framebuffer.bind():
        target.framebuffer.clear(color=(0.0, 0.0, 0.0, 0.0))
        try:
            gpu_state.viewport_set(0, 0, target.width, target.height)
            gpu_state.blend_set("ALPHA_PREMULT")
            gpu_state.depth_test_set("NONE")
            gpu_state.depth_mask_set(False)
            shader.bind()
            named = {"orders": order, "points": pose.points, "rotations": pose.rotations, "scales": pose.scales}
            for name, texture in {**named, "colors": colors, "objects": objects}.items():
                shader.uniform_sampler(name, texture)
            if depths is not None:
                shader.uniform_sampler("depths", depths)
            parallel = is_orthographic(P)
            shader.uniform_float("lens", (P[2, 2], P[2, 3], 0.0, 1.0 if parallel else 0.0))
            shader.uniform_float("focal", (P[0, 0], P[1, 1]))
            shader.uniform_float("shift", (P[0, 2], P[1, 2]))
            shader.uniform_float("offset", (P[0, 3], P[1, 3]))
            shader.uniform_float("size", (target.width, target.height))
            shown = pose.count if count is None else count
            if shown:
                square().draw_instanced(shader, instance_start=0, instance_count=shown)
        finally:
            gpu_state.blend_set(before[0])
            gpu_state.depth_test_set(before[1])
            gpu_state.depth_mask_set(before[2])
    gpu_state.viewport_set(*before[3])


def read_target(target: Target) -> NDArray[np.float32]:
    """The target's pixels (H, W, 4), premultiplied sRGB and alpha; the first row is the lowest."""
    # The texture and not the framebuffer, which belongs to the context that made it: a window's, or the drawing's own.
    buffer = target.texture.read()
    buffer.dimensions = target.width * target.height * 4
    return np.array(buffer, np.float32).reshape(target.height, target.width, 4)


def draw_splats(
    data: Sequence[DrawnSplats],
    view: ArrayLike,
    projection: ArrayLike,
    width: int,
    height: int,
    *,
    depth: NDArray[Any] | None = None,
) -> NDArray[np.float32]:
    """A picture (height, width, 4) of splats, premultiplied sRGB and alpha; the first row is the upper one.

    Needs a GPU context (a window, or `gpu.init()`); binds a target of its own, so it may be called in any draw handler
    or operator. Objects are sorted into one another. view (4, 4): world to view axes; projection (4, 4) as Blender and
    OpenGL have it, perspective or orthographic. `core.render.screen_space.camera_matrices` gives both for a `Camera`.
    depth (height, width): window depths, 0 near to 1 far by the same projection, of what may hide splats; first row
    the upper one.
    """
    target = make_target(width, height)
    order, colors = arrange(data, view, projection)
    draw_into(
        target, pose_textures(data), [splats.matrix for splats in data], order_texture(order),
        color_texture([(rgb, splats.opacities) for splats, rgb in zip(data, colors, strict=True)]),
        view, projection, depths=None if depth is None else image_texture(depth[::-1]),
    )  # fmt: skip
    return read_target(target)[::-1]
