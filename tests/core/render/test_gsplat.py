# SPDX-License-Identifier: GPL-3.0-or-later
"""What gsplat is given, held against the reference through a torch stand-in with its signature and its rules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gskin_addon.core.render import reference
from gskin_addon.core.render.camera import Camera, look_at
from gskin_addon.core.render.cpu import backend as cpu
from gskin_addon.core.render.gsplat_backend import GsplatScene
from gskin_addon.core.render.photometric import photometric_loss
from gskin_addon.core.render.torch_loss import photometric_losses

BACKGROUND = (0.2, 0.5, 0.9)


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    packed: bool = True,
    backgrounds: Tensor | None = None,
    rasterize_mode: str = "classic",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat.rasterization (1.5.3) for batches of one camera each, with the shapes that it asserts."""
    batch, count, cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    assert means.shape == (*batch, count, 3)
    assert quats.shape == (*batch, count, 4)
    assert scales.shape == (*batch, count, 3)
    assert opacities.shape == (*batch, count)
    assert colors.shape == (*batch, count, 3)
    assert viewmats.shape == (*batch, cameras, 4, 4)
    assert Ks.shape == (*batch, cameras, 3, 3)
    assert backgrounds is not None
    assert backgrounds.shape == (*batch, cameras, 3)
    assert rasterize_mode == "classic"
    assert not packed
    images, alphas = [], []
    for b in range(batch[0]):
        view, K = viewmats[b, 0].double().numpy(), Ks[b, 0].double().numpy()
        camera = Camera(
            view[:3, :3], view[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height, near_plane
        )
        image, alpha = reference.render(
            means[b], quats[b], scales[b], colors[b], opacities[b], camera, backgrounds[b, 0], dilation=eps2d
        )
        images.append(image.float())
        alphas.append(alpha.float()[..., None])
    return torch.stack(images)[:, None], torch.stack(alphas)[:, None], {}


def arrays(count: int = 60) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    rng = np.random.default_rng(4)
    constant = np.exp(rng.normal(-2.5, 0.5, (count, 3))), rng.random((count, 3)), rng.uniform(0.05, 0.98, count)
    means, quats = rng.normal(0, 0.35, (3, count, 3)), rng.normal(size=(3, count, 4))
    f = np.float32
    return means.astype(f), quats.astype(f), tuple(c.astype(f) for c in constant)


def cameras() -> list[Camera]:
    return [look_at(eye, (0, 0, 0), size=(24, 36), near=0.2) for eye in ((0.2, -3, 0.3), (2.5, -2, 0), (-2, 2, 1))]


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


@pytest.mark.parametrize("compensate", [None, 0.05])
def test_it_draws_what_the_cpu_draws(compensate: float | None) -> None:
    means, quats, constant = arrays()
    other = cpu.prepare(*constant, compensate=compensate, dilation=0.4)
    scene = GsplatScene(*constant, 0.4, compensate, rasterization, "cpu")
    rng = np.random.default_rng(1)
    camera = cameras()[0]
    grad_image, grad_alpha = rng.normal(size=(24, 36, 3)), rng.normal(size=(24, 36))
    frame, wanted = (s.forward(means[0], quats[0], camera, BACKGROUND) for s in (scene, other))
    assert np.abs(frame.image - wanted.image).mean() < 1e-5
    assert np.abs(frame.alpha - wanted.alpha).mean() < 1e-5
    for given in ((grad_image, grad_alpha), (grad_image,)):
        mine, theirs = scene.backward(frame, *given), other.backward(wanted, *given)
        assert relative(mine[0], theirs[0]) < 1e-4
        assert relative(mine[1], theirs[1]) < 1e-4
    assert np.array_equal(
        scene.contribution(means[0], quats[0], camera), other.contribution(means[0], quats[0], camera)
    )


def test_a_batch_with_photometric_losses_and_with_ones_own() -> None:
    means, quats, constant = arrays()
    other = cpu.prepare(*constant, compensate=0.1)
    scene = GsplatScene(*constant, 0.3, 0.1, rasterization, "cpu")
    targets = [np.full((24, 36, 3), shade, np.uint8) for shade in (40, 120, 255)]
    photometric = [photometric_loss(t, BACKGROUND, weight=0.3) for t in targets]
    plain = [lambda image, alpha: (float(image.sum()), np.ones_like(image))] * 3
    for losses in (photometric, plain):
        mine = scene.render_and_grad_many(means, quats, cameras(), losses, BACKGROUND)
        theirs = other.render_and_grad_many(means, quats, cameras(), losses, BACKGROUND)
        for a, b in zip(mine, theirs, strict=True):
            assert relative(a, b) < 1e-4


def test_the_loss_in_torch_is_the_one_of_the_cpu() -> None:
    rng = np.random.default_rng(0)
    images = rng.random((2, 20, 31, 3)).astype(np.float32)
    targets = [rng.random((20, 31, 3)).astype(np.float32), rng.integers(0, 256, (20, 31, 3)).astype(np.uint8)]
    losses = [photometric_loss(t, weight=w) for t, w in zip(targets, (0.2, 0.5), strict=True)]
    leaf = torch.tensor(images, requires_grad=True)
    values = photometric_losses(leaf, losses)
    values.sum().backward()
    assert leaf.grad is not None
    for p, loss in enumerate(losses):
        value, grad = loss(images[p], np.ones((20, 31), np.float32))
        assert float(values[p].detach()) == pytest.approx(value, rel=1e-5)
        assert relative(leaf.grad[p].numpy(), grad) < 1e-4
