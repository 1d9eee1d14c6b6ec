# SPDX-License-Identifier: GPL-3.0-or-later
"""The drawn target laid over Blender's view, and what Blender has drawn there: depths, and bones in front."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .drawing import Target
from .marks import Marks
from .shaders import composite_shader, gpu_state, square
from .textures import image_texture

THIN, OPAQUE = 0.75, 0.9
"""Alpha of the overlay from which on its pixels count as drawn in front, a little and wholly: lines have soft edges,
the floor's grid is fainter."""


def view_depths() -> NDArray[np.float32] | None:
    """Window depths (H, W) of the view being drawn, 0 near to 1 far, first row the lowest.

    None where nothing is known: Material Preview without overlays has 0 everywhere.
    """
    x, y, width, height = gpu_state.viewport_get()
    buffer = gpu_state.active_framebuffer_get().read_depth(x, y, width, height)
    buffer.dimensions = width * height
    depths = np.array(buffer, np.float32).reshape(height, width)
    return depths if depths.any() else None


def overlay_in_front() -> NDArray[np.float32]:
    """How much (H, W), 0 to 1, Blender's overlay stays before all, as bones with In Front do."""
    x, y, width, height = gpu_state.viewport_get()
    buffer = gpu_state.active_framebuffer_get().read_color(x, y, width, height, 4, 0, "FLOAT")
    buffer.dimensions = width * height * 4
    alpha = np.array(buffer, np.float32).reshape(height, width, 4)[..., 3]
    return np.where(alpha < THIN, np.float32(0.0), np.minimum(alpha / np.float32(OPAQUE), np.float32(1.0)))


def lay_over(
    target: Target, *, outlined: Any = None, outline: tuple[float, float, float] | None = None, reach: int = 1,
    overlay: NDArray[np.float32] | None = None, marks: Marks | None = None,
) -> None:  # fmt: skip
    """Draw the target over the view's framebuffer, decoded to linear colours, which Blender encodes again.

    outlined: the texture whose alpha is outlined in `outline` (linear), `reach` pixels wide; overlay: how much of
    Blender's overlay stays (H, W); marks: what Edit Mode has selected, drawn over the splats.
    """
    shader = composite_shader()
    x, y, _, _ = gpu_state.viewport_get()
    before = gpu_state.blend_get(), gpu_state.depth_test_get(), gpu_state.depth_mask_get()
    try:
        gpu_state.blend_set("ALPHA_PREMULT")
        gpu_state.depth_test_set("NONE")
        gpu_state.depth_mask_set(False)
        shader.bind()
        shader.uniform_sampler("drawn", target.texture)
        shader.uniform_sampler("outlined", outlined or target.texture)
        kept = None if overlay is None else image_texture(overlay)
        shader.uniform_sampler("overlay", kept or target.texture)
        shader.uniform_sampler("marks", target.texture if marks is None else marks.texture)
        shader.uniform_float("mark_opacity", 0.0 if marks is None else marks.opacity)
        shader.uniform_float("outline_color", (*outline, 1.0) if outline else (0.0, 0.0, 0.0, 0.0))
        shader.uniform_float("corner_of_view", (x, y))
        shader.uniform_float("keep_overlay", 0.0 if overlay is None else 1.0)
        shader.uniform_int("reach", reach)
        square().draw(shader)
    finally:
        gpu_state.blend_set(before[0])
        gpu_state.depth_test_set(before[1])
        gpu_state.depth_mask_set(before[2])
