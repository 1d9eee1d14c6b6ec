# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasteriser in numpy alone against the float64 reference; depth, and what hides splats."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from render_scenes import SCENES, make_scene

from gskin_addon.core.render import fragments
from gskin_addon.core.render.camera import Camera, look_at
from gskin_addon.core.render.triangles import depth_of_triangles


def orthographic(camera: Camera) -> Camera:
    """About the same part of the scene, seen along parallel rays."""
    return replace(camera, orthographic=True, fx=camera.fx / 3, fy=camera.fy / 3)


def rasterisers():
    """`draw` of numpy and, where there is one, of numba."""
    found = [fragments.draw]
    if importlib.util.find_spec("numba") is not None:
        from gskin_addon.core.render.cpu import still

        found.append(still.draw)
    return found


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("draw", rasterisers())
def test_as_the_reference(draw, name, parallel, monkeypatch):
    torch = pytest.importorskip("torch")
    from gskin_addon.core.render import reference

    monkeypatch.setattr(fragments, "RUN", 700)  # several runs, each behind the one before
    arrays, camera = make_scene(name)
    camera = orthographic(camera) if parallel else camera
    image, alpha = reference.render(*map(torch.tensor, arrays), camera, torch.zeros(3))
    picture = fragments.draw(*arrays, camera)
    assert image.max() > 0.05
    # Ties and the cut at 1/255 may flip single pixels.
    assert np.abs(picture.color - image.numpy()).mean() < 1e-6
    assert np.abs(picture.alpha - alpha.numpy()).mean() < 1e-6


def row_of_splats(depths, opacities, camera=None):
    """Opaque discs one behind the other, each of its own grey."""
    count = len(depths)
    means = np.array([[0.0, depth - 3.0, 0.0] for depth in depths])
    colors = np.linspace(0.2, 0.8, count)[:, None] * np.ones(3)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    camera = camera or look_at((0, -3, 0), (0, 0, 0), size=32)
    return (means, quats, np.full((count, 3), 0.3), colors, np.array(opacities)), camera


@pytest.mark.parametrize("draw", rasterisers())
def test_depth_is_where_half_of_the_light_is_gone(draw):
    splats, camera = row_of_splats([4.0, 2.0, 3.0], [0.9, 0.3, 0.6])
    depth = draw(*splats, camera).depth
    assert depth[16, 16] == pytest.approx(3.0)  # 0.3, then 1 - 0.7 * 0.4
    assert np.isinf(depth[0, 0])


@pytest.mark.parametrize("draw", rasterisers())
def test_what_stands_before_a_splat_hides_it(draw):
    splats, camera = row_of_splats([2.0, 4.0], [0.5, 0.9])
    limit = np.full((32, 32), np.inf, np.float32)
    limit[:, :16], limit[:, 24:] = 3.0, 1.0
    free, hidden = draw(*splats, camera), draw(*splats, camera, limit)
    near = draw(*(array[:1] for array in splats), camera)
    assert np.allclose(hidden.color[:, 16:24], free.color[:, 16:24])
    assert np.allclose(hidden.color[:, :16], near.color[:, :16])
    assert near.alpha[16, 15] > 0.4
    assert not hidden.alpha[:, 24:].any()


@pytest.mark.parametrize("draw", rasterisers())
def test_nothing_to_draw_is_an_empty_picture(draw):
    splats, camera = row_of_splats([-1.0], [0.9])
    picture = draw(*splats, camera)
    assert not picture.alpha.any()
    assert not picture.color.any()
    assert np.isinf(picture.depth).all()
    assert np.allclose(picture.over((0.2, 0.3, 0.4)), (0.2, 0.3, 0.4))


def ray_depth(corners, camera):
    """Depth at every pixel centre by meeting each ray with each triangle (Moeller and Trumbore 1997)."""
    height, width = camera.size
    depth = np.full((height, width), np.inf)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    flat = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], -1)
    zero, one = np.zeros((*flat.shape[:2], 1)), np.ones((*flat.shape[:2], 1))
    origin = np.concatenate([flat, zero], -1) if camera.orthographic else np.zeros((*flat.shape[:2], 3))
    ray = np.concatenate([zero, zero, one] if camera.orthographic else [flat, one], -1)
    for a, b, c in camera.to_camera(corners):
        p = np.cross(ray, c - a)
        det = p @ (b - a)
        safe = np.where(det == 0, 1.0, det)
        u = ((origin - a) * p).sum(-1) / safe
        q = np.cross(origin - a, b - a)
        v, t = (ray * q).sum(-1) / safe, q @ (c - a) / safe
        hit = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > camera.near)
        depth = np.where(hit & (t < depth), t, depth)
    return depth


@pytest.mark.parametrize("parallel", [False, True])
def test_triangles_are_as_far_as_rays_find_them(parallel):
    rng = np.random.default_rng(3)
    corners = rng.normal(0, 0.8, (40, 1, 3)) + rng.normal(0, 0.5, (40, 3, 3))
    corners[:6, :, 1] -= 2.5  # around the camera, cut by its near plane
    camera = look_at((0.2, -3.0, 0.3), (0, 0, 0), size=(40, 56), near=0.1)
    camera = orthographic(camera) if parallel else camera
    found, wanted = depth_of_triangles(corners, camera), ray_depth(corners, camera)
    differs = ~np.isclose(found, wanted, rtol=1e-4)
    assert np.isfinite(wanted).mean() > 0.3
    assert differs.mean() < 0.003  # a ray through an edge


def test_no_triangles_hide_nothing():
    camera = look_at((0, -3, 0), (0, 0, 0), size=8)
    assert np.isinf(depth_of_triangles(np.zeros((0, 3, 3)), camera)).all()
