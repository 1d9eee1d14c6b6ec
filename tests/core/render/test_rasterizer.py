# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch
from render_scenes import SCENES, make_scene

from gskin_addon.core.errors import InputError
from gskin_addon.core.render import reference
from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.cpu.backend import CpuScene, prepare
from gskin_addon.core.render.rasterizer import resolve_backend
from gskin_addon.core.splats.morton import morton_order

BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


@pytest.mark.parametrize("compensate", [None, 0.05])
@pytest.mark.parametrize("name", SCENES)
def test_matches_brute_force(name: str, compensate: float | None) -> None:
    (means, quats, scales, colors, opacities), camera = make_scene(name)
    rng = np.random.default_rng(7)
    grad_image = rng.normal(size=(*camera.size, 3)).astype(np.float32)
    grad_alpha = rng.normal(size=camera.size).astype(np.float32)

    m = torch.tensor(means, dtype=torch.float64, requires_grad=True)
    q = torch.tensor(quats, dtype=torch.float64, requires_grad=True)
    image, alpha = reference.render(
        m,
        q,
        *map(torch.tensor, (scales, colors, opacities)),
        camera,
        torch.tensor(BACKGROUND),
        compensate=compensate,
    )
    ((image * torch.tensor(grad_image)).sum() + (alpha * torch.tensor(grad_alpha)).sum()).backward()
    assert m.grad is not None
    assert q.grad is not None
    assert alpha.max() > 0.5, "the scene shows nothing"

    scene = prepare(scales, colors, opacities, compensate=compensate)
    frame = scene.forward(means, quats, camera, BACKGROUND)
    grad_means, grad_quats = scene.backward(frame, grad_image, grad_alpha)
    assert np.abs(frame.image - image.detach().numpy()).mean() < 1e-5
    assert np.abs(frame.alpha - alpha.detach().numpy()).mean() < 1e-5
    assert relative(grad_means, m.grad.numpy()) < 1e-4
    assert relative(grad_quats, q.grad.numpy()) < 1e-4


def test_gradient_follows_finite_differences() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("plain")
    rng = np.random.default_rng(3)
    grad_image = torch.tensor(rng.normal(size=(*camera.size, 3)))
    constants = [torch.tensor(a, dtype=torch.float64) for a in (scales, colors, opacities)]

    def loss(m: np.ndarray, q: np.ndarray) -> float:
        image, _ = reference.render(torch.tensor(m), torch.tensor(q), *constants, camera, torch.tensor(BACKGROUND))
        return float((image * grad_image).sum())

    scene = prepare(scales, colors, opacities)
    grad_means, grad_quats = scene.backward(scene.forward(means, quats, camera, BACKGROUND), grad_image.numpy())
    m, q = means.astype(np.float64), quats.astype(np.float64)
    for _ in range(4):
        dm, dq = rng.normal(size=m.shape), rng.normal(size=q.shape)
        h = 1e-7
        slope = (loss(m + h * dm, q + h * dq) - loss(m - h * dm, q - h * dq)) / (2 * h)
        assert slope == pytest.approx(float((grad_means * dm).sum() + (grad_quats * dq).sum()), rel=2e-3)


def test_threads_and_many_images_change_nothing() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("partly_off_screen")
    scene = prepare(scales, colors, opacities)
    assert isinstance(scene, CpuScene)
    grad = np.random.default_rng(0).normal(size=(*camera.size, 3)).astype(np.float32)
    single = scene.forward(means, quats, camera, threads=1)
    shared = scene.forward(means, quats, camera, threads=3)
    assert np.array_equal(single.image, shared.image)
    for a, b in zip(scene.backward(single, grad), scene.backward(shared, grad), strict=True):
        assert np.array_equal(a, b)

    def loss(image: np.ndarray, alpha: np.ndarray) -> tuple[float, np.ndarray]:
        return float((image * grad).sum()), grad

    for count in (1, 5):
        values, gm, gq = scene.render_and_grad_many(
            np.stack([means] * count), np.stack([quats] * count), [camera] * count, [loss] * count
        )
        value, gm0, gq0 = scene.render_and_grad(means, quats, camera, loss)
        assert np.allclose(values, value)
        assert all(np.array_equal(gm[k], gm0) and np.array_equal(gq[k], gq0) for k in range(count))


def test_contribution_is_the_largest_weight() -> None:
    camera = look_at((0, -3, 0), (0, 0, 0), size=65)
    means = np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, -9, 0], [0.5, 0, 0.5]], np.float32)
    quats = np.tile(np.float32([1, 0, 0, 0]), (5, 1))
    scene = prepare(np.full((5, 3), 0.1), np.ones((5, 3)), [0.6, 0.5, 1.0, 1.0, 0.002])
    most = scene.contribution(means, quats, camera)
    assert most[0] == pytest.approx(0.6, abs=1e-3)
    assert 0.2 < most[1] < 0.5  # half hidden at its centre, less so beside it
    assert 0.2 < most[2] < 0.99
    assert most[3] == 0, "it stands behind the camera"
    assert most[4] == 0, "it is too faint to draw"


def test_pruning_by_contribution_keeps_the_picture() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("near_opaque")
    scene = prepare(scales, colors, opacities)
    keep = scene.contribution(means, quats, camera) > 0.01
    assert 0 < keep.sum() < len(means)
    image, alpha = scene.render(means, quats, camera)
    pruned, _ = prepare(scales[keep], colors[keep], opacities[keep]).render(means[keep], quats[keep], camera)
    assert np.abs(image - pruned).mean() < 2e-3
    assert alpha.max() > 0.99


def test_compensated_low_resolution_looks_like_the_large_image_made_small() -> None:
    rng = np.random.default_rng(5)
    n, size = 400, 256
    means = rng.normal(0, 0.3, (n, 3)).astype(np.float32)
    quats = rng.normal(size=(n, 4)).astype(np.float32)
    arrays = np.full((n, 3), 0.004, np.float32), rng.uniform(0, 1, (n, 3)), np.full(n, 0.9, np.float32)
    large = look_at((0, -3, 0), (0, 0, 0), size=size)
    small = large.resized(size // 2)
    image, _ = prepare(*arrays).render(means, quats, large)
    wanted = image.reshape(size // 2, 2, size // 2, 2, 3).mean(axis=(1, 3))
    plain, _ = prepare(*arrays).render(means, quats, small)
    compensated, _ = prepare(*arrays, compensate=0.3 / 4).render(means, quats, small)
    assert np.abs(compensated.mean() - wanted.mean()) < 0.3 * np.abs(plain.mean() - wanted.mean())
    assert np.abs(compensated - wanted).mean() < 0.7 * np.abs(plain - wanted).mean()


def test_nothing_to_draw_gives_the_background() -> None:
    camera = look_at((0, -3, 0), (0, 0, 0), size=(33, 40))
    scene = prepare(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    frame = scene.forward(np.zeros((0, 3)), np.zeros((0, 4)), camera, BACKGROUND)
    assert np.array_equal(frame.image, np.broadcast_to(BACKGROUND, (33, 40, 3)))
    assert not frame.alpha.any()
    assert scene.backward(frame, np.ones((33, 40, 3)))[0].shape == (0, 3)


def test_broken_splats_are_left_out() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("plain")
    scene = prepare(scales, colors, opacities)
    opacities = opacities.copy()
    opacities[:4] = 0
    image, _ = prepare(scales, colors, opacities).render(means, quats, camera)
    means[0], means[1], quats[2], quats[3] = np.nan, np.inf, 0, np.nan
    broken = scene.forward(means, quats, camera)
    assert np.array_equal(broken.image, image)
    grads = scene.backward(broken, np.ones_like(image))
    assert all(np.isfinite(g).all() for g in grads)


def test_wrong_shapes_and_names_are_refused() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("plain")
    with pytest.raises(InputError):
        prepare(scales[1:], colors, opacities)
    with pytest.raises(InputError):
        prepare(scales, colors, opacities).forward(means[1:], quats, camera)
    with pytest.raises(InputError, match="cpu"):
        resolve_backend("gpu9")


def test_morton_order_keeps_neighbours_together() -> None:
    p = np.random.default_rng(0).uniform(size=(2000, 3))
    order = morton_order(p)
    assert np.array_equal(np.sort(order), np.arange(2000))
    step = np.linalg.norm(np.diff(p[order], axis=0), axis=1).mean()
    assert step < 0.25 * np.linalg.norm(np.diff(p, axis=0), axis=1).mean()
