# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch

from gskin_addon.core.errors import InputError
from gskin_addon.core.render.image_metrics import C1, C2, gaussian_window, psnr, ssim, ssim_map
from gskin_addon.core.render.photometric import content_box, l1_dssim, photometric_loss, union


def torch_ssim_map(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """(H,W,3) each; the published 3DGS code: conv2d with padding 5."""
    w = torch.tensor(gaussian_window())
    kernel = torch.outer(w, w).expand(3, 1, 11, 11)

    def f(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[None], kernel, padding=5, groups=3)

    mx, my = f(x), f(y)
    sx, sy, sxy = f(x * x) - mx * mx, f(y * y) - my * my, f(x * y) - mx * my
    s = (2 * mx * my + C1) * (2 * sxy + C2) / ((mx * mx + my * my + C1) * (sx + sy + C2))
    return s[0].permute(1, 2, 0)


def torch_loss(x: torch.Tensor, y: torch.Tensor, weight: float) -> torch.Tensor:
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - torch_ssim_map(x, y).mean())


def pictures(seed: int = 0, shape: tuple[int, int] = (37, 52)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = np.cumsum(rng.normal(0, 0.05, (*shape, 3)), axis=1) % 1.0
    return a, np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)


def test_window_is_the_fields() -> None:
    w = gaussian_window()
    assert np.isclose(w.sum(), 1)
    assert np.isclose(w[5] / w[4], np.exp(1 / 4.5))


def test_ssim_equals_the_convolution() -> None:
    a, b = pictures()
    slow = torch_ssim_map(torch.tensor(a), torch.tensor(b)).numpy()
    assert np.allclose(ssim_map(a, b), slow, atol=1e-10)
    assert 0.1 < ssim(a, b) < 0.98
    assert ssim(a, a) == pytest.approx(1)


def test_psnr() -> None:
    a = np.zeros((4, 5, 3))
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert psnr(a, a) == float("inf")
    with pytest.raises(InputError):
        psnr(a, a[1:])


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("shape", [(37, 52), (6, 9)])
def test_fused_loss_matches_autograd(weight: float, shape: tuple[int, int]) -> None:
    a, b = (p.astype(np.float32) for p in pictures(1, shape))
    x = torch.tensor(a, dtype=torch.float64, requires_grad=True)
    loss = torch_loss(x, torch.tensor(b, dtype=torch.float64), weight)
    loss.backward()
    assert x.grad is not None
    value, grad = l1_dssim(a, b, weight=weight)
    assert value == pytest.approx(loss.item(), rel=1e-5)
    assert np.linalg.norm(grad - x.grad.numpy()) < 1e-4 * np.linalg.norm(x.grad.numpy())


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_cropped_loss_equals_the_whole_image(dtype: type) -> None:
    a, b = (p.astype(np.float32) for p in pictures(2, (20, 16)))
    background = np.array([1.0, 0.5, 0.25], np.float32) if dtype == np.float32 else np.ones(3, np.float32)
    render = np.broadcast_to(background, (90, 70, 3)).copy()
    target, alpha = render.copy(), np.zeros((90, 70), np.float32)
    render[30:50, 24:40], alpha[30:50, 24:40] = a, 1.0
    target[41:61, 30:46] = b
    if dtype == np.uint8:
        target = np.round(target * 255).astype(np.uint8)
    whole = target.astype(np.float32) / (255 if dtype == np.uint8 else 1)
    value, grad = l1_dssim(render, whole)
    cropped_value, cropped_grad = photometric_loss(target, background)(render, alpha)
    assert cropped_value == pytest.approx(value, rel=1e-5)
    seen = alpha > 0  # a render's gradient matters where splats are
    assert np.linalg.norm((cropped_grad - grad)[seen]) < 1e-4 * np.linalg.norm(grad[seen])
    assert np.count_nonzero(cropped_grad) < 0.6 * cropped_grad.size


def test_boxes() -> None:
    mask = np.zeros((50, 60), bool)
    assert content_box(mask) == (0, 0, 0, 0)
    mask[20, 5] = True
    assert content_box(mask) == (10, 31, 0, 16)
    assert union((0, 0, 0, 0), (1, 2, 3, 4)) == (1, 2, 3, 4) == union((1, 2, 3, 4), (0, 0, 0, 0))
    assert union((1, 5, 3, 4), (0, 2, 3, 9)) == (0, 5, 3, 9)


def test_nothing_to_see_costs_nothing() -> None:
    white = np.ones((20, 20, 3), np.float32)
    value, grad = photometric_loss(white)(white, np.zeros((20, 20), np.float32))
    assert value == 0
    assert not grad.any()


def test_sizes_must_agree() -> None:
    a, b = pictures()
    with pytest.raises(InputError):
        l1_dssim(a, b[1:])
    with pytest.raises(InputError):
        photometric_loss(b)(a[1:].astype(np.float32), np.ones(a.shape[:2], np.float32)[1:])
