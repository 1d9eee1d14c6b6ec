# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
from without import output_without

from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.splats.cloud import SplatCloud

C0, C1 = 0.28209479177387814, 0.4886025119029199


def test_a_cloud_is_drawn_upright_and_coloured_by_direction() -> None:
    """One splat up and to the object's left: red from -y, blue from +y (degree 1 SH in y)."""
    sh = np.zeros((1, 4, 3), np.float32)
    # Colour = 0.5 + C0 sh0 - C1 y sh1 + ...; y is the direction from the camera, +1 for the front camera.
    sh[0, 1] = np.array([-0.5, 0.0, 0.5]) / C1
    sh[0, 0, 1] = -0.5 / C0
    cloud = SplatCloud(
        means=np.array([[0.4, 0, 0.8]], np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.05, np.float32),
        opacities=np.ones(1, np.float32),
        sh=sh,
    )
    front, back, *_ = paper_views((-0.5, -0.5, 0), (0.5, 0.5, 1), 64)
    for camera, color, side in ((front, (1, 0, 0), 1), (back, (0, 0, 1), -1)):
        image, alpha = render_cloud(cloud, camera, (0, 0, 0))
        row, column = np.unravel_index(np.argmax(alpha), alpha.shape)
        assert row < 32
        assert np.sign(column - 32) == side
        assert np.allclose(image[row, column] / alpha[row, column], color, atol=0.1)
        assert image.dtype == alpha.dtype == np.float32


def test_without_numba_numpy_draws_the_same_picture() -> None:
    code = """
import numpy as np
from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.splats.cloud import SplatCloud
rng = np.random.default_rng(0)
cloud = SplatCloud(rng.normal(0, 0.4, (50, 3)), np.tile([1.0, 0, 0, 0], (50, 1)), np.full((50, 3), 0.1),
                   np.full(50, 0.7), rng.normal(0, 0.5, (50, 4, 3)))
image, alpha = render_cloud(cloud, look_at((0, -3, 0), (0, 0, 0), size=24), (0.2, 0.4, 0.6))
print(",".join(f"{value:.5f}" for value in np.append(image, alpha)))
"""
    plain, compiled = (
        np.array(output_without(modules, code).split(","), float) for modules in (("numba",), ("no_such_module",))
    )
    np.testing.assert_allclose(plain, compiled, atol=2e-5)
