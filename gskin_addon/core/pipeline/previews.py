# SPDX-License-Identifier: GPL-3.0-or-later
"""Images of a job's result, for later inspection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..guidance.control import ControlSignal
from ..guidance.mask import painting_mask
from ..render.camera import Camera
from ..render.rasterizer import render_cloud
from ..rig.colors import weight_colors
from ..rig.lbs import skin_cloud
from ..skinning.optimise import Target
from ..splats.cloud import SH_C0, SplatCloud

Image = NDArray[Any]
_HANDLE, _TARGET = (0.1, 0.3, 1.0), (1.0, 0.15, 0.1)


def preview_images(
    cloud: SplatCloud,
    initial: NDArray[Any],
    weights: NDArray[Any],
    cameras: Sequence[Camera],
    signals: Sequence[ControlSignal],
    targets: Sequence[Target],
) -> dict[str, Image]:
    """`weights`: splats in their bones' colours, from all cameras; `guidance`: for some poses the control
    points, the painting mask, the guidance image, and the splats posed with initial and learned weights; left out
    where there was no guidance."""
    sheet = np.concatenate([weights_picture(cloud, weights, camera) for camera in cameras], axis=1)
    if not signals:
        return {"weights": sheet}
    rows = []
    for number in np.linspace(0, len(signals) - 1, min(4, len(signals))).astype(int):
        signal, target = signals[number], targets[number]
        rest = render_cloud(cloud, signal.camera)[0]
        before = render_cloud(skin_cloud(cloud, initial, signal.transforms), signal.camera)[0]
        after = render_cloud(skin_cloud(cloud, weights, signal.transforms), signal.camera)[0]
        mask = painting_mask(rest, before, signal.handles, signal.targets)
        shaded = rest * np.where(mask, 1.0, 0.6)[..., None]
        control = draw_points(shaded, signal.handles, signal.targets)
        rows.append(np.concatenate([control, target.image / 255.0, before, after], axis=1))
    return {"weights": sheet, "guidance": np.concatenate(rows)}


def weights_picture(cloud: SplatCloud, weights: NDArray[Any], camera: Camera) -> Image:
    """The splats in the colours of their bones, mixed by weights (N, B)."""
    colors = ((weight_colors(weights) - 0.5) / SH_C0)[:, None, :].astype(np.float32)
    return render_cloud(replace(cloud, sh=colors), camera)[0]


def guidance_picture(signal: ControlSignal, target: Target) -> Image:
    """A guidance image with the points that asked for it: where they were in blue, where they shall be in red."""
    return draw_points(target.image / 255.0, signal.handles, signal.targets)


def draw_points(image: Image, handles: NDArray[Any], targets: NDArray[Any]) -> Image:
    """A copy of the image with handle points blue, target points red, as in the paper's figures."""
    out = np.array(image)
    height, width = out.shape[:2]
    radius = max(2, height // 170)
    for points, color in ((handles, _HANDLE), (targets, _TARGET)):
        for x, y in points:
            row, column = int(y), int(x)
            if 0 <= row < height and 0 <= column < width:
                box = out[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
                box[:] = color
    return out
