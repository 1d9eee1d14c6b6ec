# SPDX-License-Identifier: GPL-3.0-or-later
"""Small scenes, each hard in its own way, for comparing rasterisers."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.render.camera import Camera, look_at

SCENES = (
    "plain",
    "anisotropic",
    "partly_off_screen",
    "behind_camera",
    "near_opaque",
    "one_tile",
    "off_center",
    "huge_and_thin",
    "crowded",
)


def make_scene(name: str) -> tuple[list[np.ndarray], Camera]:
    """[means, quats, scales, colors, opacities] (float32) and a camera."""
    rng = np.random.default_rng(SCENES.index(name))
    n = 60
    means = rng.normal(0, 0.35, (n, 3))
    quats = rng.normal(size=(n, 4))
    scales = np.exp(rng.normal(-2.5, 0.5, (n, 3)))
    colors = rng.uniform(0, 1, (n, 3))
    opacities = rng.uniform(0.05, 0.95, n)
    camera = look_at((0.3, -3.0, 0.4), (0, 0, 0), size=(48, 72))
    if name == "anisotropic":
        scales = np.exp(rng.uniform(-7, -0.5, (n, 3)))
    elif name == "partly_off_screen":
        means[:, 0] *= 5
        scales *= 3
    elif name == "behind_camera":
        means[:, 1] = rng.uniform(-6, 1, n)
        camera = look_at((0, -3, 0), (0, 0, 0), size=(40, 40), near=0.2)
    elif name == "near_opaque":
        opacities = rng.uniform(0.97, 1.0, n)
        scales = np.exp(rng.normal(-1.5, 0.3, (n, 3)))
    elif name == "one_tile":
        camera = look_at((1, -2, 0.5), (0, 0, 0), size=(17, 11))
    elif name == "off_center":
        camera = Camera(camera.rotation, camera.translation, 70.0, 110.0, 20.0, 60.0, 101, 67)
    elif name == "huge_and_thin":
        scales = np.exp(rng.uniform(-6, 3, (n, 3)))
        opacities = rng.uniform(0.02, 0.3, n)
    elif name == "crowded":
        # More splats in a tile than are fetched at once, and pixels that end long before the last of them.
        n = 400
        means, quats = rng.normal(0, 0.5, (n, 3)), rng.normal(size=(n, 4))
        scales, colors = np.exp(rng.normal(-1.5, 0.4, (n, 3))), rng.uniform(0, 1, (n, 3))
        opacities = rng.uniform(0.5, 1.0, n)
        camera = look_at((0.3, -3.0, 0.4), (0, 0, 0), size=(40, 40))
    arrays = [np.ascontiguousarray(a, np.float32) for a in (means, quats, scales, colors, opacities)]
    return arrays, camera
