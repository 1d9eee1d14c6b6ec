# SPDX-License-Identifier: GPL-3.0-or-later
"""The Warp kernels, on Warp's "cpu" device, where they run one thread after the other, or on $GSKIN_WARP_DEVICE."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("warp")

from render_scenes import SCENES, make_scene

from gskin_addon.core.errors import InputError
from gskin_addon.core.render import reference
from gskin_addon.core.render.camera import Camera, look_at
from gskin_addon.core.render.cpu import backend as cpu
from gskin_addon.core.render.photometric import photometric_loss
from gskin_addon.core.render.rasterizer import prepare

DEVICE = os.environ.get("GSKIN_WARP_DEVICE", "cpu")
BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)


@pytest.fixture(autouse=True)
def _on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSKIN_WARP_DEVICE", DEVICE)


def warp_scene(*arrays: Any, **options: Any) -> Any:
    return prepare(*arrays, backend="warp", **options)


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def body(count: int = 200, seed: int = 11) -> tuple[list[np.ndarray], list[Camera]]:
    """Splats from needles to giants, some behind the cameras, and three cameras at 64 px."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 0.4, (count, 3))
    means[:10, 1] = rng.uniform(-5, -2, 10)
    scales = np.exp(rng.normal(-3, 0.7, (count, 3)))
    scales[10:20] = np.exp(rng.uniform(-6, 1, (10, 3)))
    arrays = means, rng.normal(size=(count, 4)), scales, rng.random((count, 3)), rng.uniform(0.05, 1, count)
    cameras = [look_at(eye, (0, 0, 0), size=64) for eye in ((0.2, -3, 0.3), (2.5, -2, 0), (-2, 2, 1))]
    return [np.ascontiguousarray(a, np.float32) for a in arrays], cameras


@pytest.mark.parametrize("compensate", [None, 0.05])
@pytest.mark.parametrize("name", SCENES)
def test_matches_the_reference_and_the_cpu(name: str, compensate: float | None) -> None:
    (means, quats, *constant), camera = make_scene(name)
    rng = np.random.default_rng(7)
    grad_image = rng.normal(size=(*camera.size, 3)).astype(np.float32)
    grad_alpha = rng.normal(size=camera.size).astype(np.float32)
    m = torch.tensor(means, dtype=torch.float64, requires_grad=True)
    q = torch.tensor(quats, dtype=torch.float64, requires_grad=True)
    image, alpha = reference.render(
        m, q, *map(torch.tensor, constant), camera, torch.tensor(BACKGROUND), compensate=compensate
    )
    ((image * torch.tensor(grad_image)).sum() + (alpha * torch.tensor(grad_alpha)).sum()).backward()
    assert m.grad is not None
    assert q.grad is not None

    scene = warp_scene(*constant, compensate=compensate)
    frame = scene.forward(means, quats, camera, BACKGROUND)
    grad_means, grad_quats = scene.backward(frame, grad_image, grad_alpha)
    assert np.abs(frame.image - image.detach().numpy()).mean() < 1e-5
    assert np.abs(frame.alpha - alpha.detach().numpy()).mean() < 1e-5
    assert relative(grad_means, m.grad.numpy()) < 1e-4
    assert relative(grad_quats, q.grad.numpy()) < 1e-4

    other = cpu.prepare(*constant, compensate=compensate)
    same = other.forward(means, quats, camera, BACKGROUND)
    assert np.abs(frame.image - same.image).mean() < 1e-6
    for mine, theirs in zip((grad_means, grad_quats), other.backward(same, grad_image, grad_alpha), strict=True):
        assert relative(mine, theirs) < 1e-4


def test_a_batch_equals_its_images_and_the_cpu() -> None:
    (means, quats, *constant), cameras = body()
    rng = np.random.default_rng(2)
    many = np.stack([means + rng.normal(0, 0.02, means.shape) for _ in cameras]).astype(np.float32)
    turned = np.stack([quats + rng.normal(0, 0.1, quats.shape) for _ in cameras]).astype(np.float32)
    scene, other = warp_scene(*constant), cpu.prepare(*constant)
    targets = [other.render(means, quats, camera)[0] for camera in cameras]
    targets[0] = (targets[0].clip(0, 1) * 255).astype(np.uint8)
    losses = [photometric_loss(target, weight=0.2 + 0.1 * k) for k, target in enumerate(targets)]
    values, grad_means, grad_quats = scene.render_and_grad_many(many, turned, cameras, losses)
    wanted = other.render_and_grad_many(many, turned, cameras, losses)
    assert values == pytest.approx(wanted[0], rel=1e-5)
    assert relative(grad_means, wanted[1]) < 1e-4
    assert relative(grad_quats, wanted[2]) < 1e-4
    for p, camera in enumerate(cameras):
        value, gm, gq = scene.render_and_grad_many(
            many[p : p + 1], turned[p : p + 1], [camera], losses[p : p + 1]
        )
        assert value[0] == values[p]
        assert np.array_equal(gm[0], grad_means[p])
        assert np.array_equal(gq[0], grad_quats[p])


def test_tensors_give_what_arrays_give() -> None:
    (means, quats, *constant), cameras = body()
    scene = warp_scene(*constant)
    losses = [photometric_loss(np.full((64, 64, 3), 120, np.uint8)) for _ in cameras]
    arrays = np.stack([means] * 3), np.stack([quats] * 3)
    wanted = scene.render_and_grad_many(*arrays, cameras, losses)
    assert scene.tensor_device == DEVICE
    tensors = [torch.tensor(a, requires_grad=True, device=DEVICE) for a in arrays]
    values, grad_means, grad_quats = scene.render_and_grad_tensors(*tensors, cameras, losses)
    assert np.array_equal(values, wanted[0])
    assert np.array_equal(grad_means.cpu().numpy(), wanted[1])
    assert np.array_equal(grad_quats.cpu().numpy(), wanted[2])
    with pytest.raises(ValueError, match="a tensor on meta"):
        scene.render_and_grad_tensors(*(tensor.to("meta") for tensor in tensors), cameras, losses)


def test_mixed_sizes_small_batches_and_losses_of_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    from gskin_addon.core.render import batches

    (means, quats, *constant), cameras = body(60)
    cameras = [*cameras, cameras[0].resized(40), cameras[1].resized(40)]
    rng = np.random.default_rng(0)
    signs = [rng.normal(size=(*camera.size, 3)).astype(np.float32) for camera in cameras]

    def loss(k: int) -> Any:
        return lambda image, alpha: (float((image * signs[k]).sum() + alpha.sum() * 0), signs[k])

    losses = [loss(k) for k in range(5)]
    arrays = np.stack([means] * 5), np.stack([quats] * 5)
    wanted = cpu.prepare(*constant).render_and_grad_many(*arrays, cameras, losses)
    scene = warp_scene(*constant)
    found = scene.render_and_grad_many(*arrays, cameras, losses)
    for mine, theirs in zip(found, wanted, strict=True):
        assert relative(mine, theirs) < 1e-4
    one = scene.forward(means, quats, cameras[0]).state.pairs
    monkeypatch.setattr(batches, "PAIRS_AT_ONCE", one)
    halved = scene.render_and_grad_many(*arrays, cameras, losses)
    for mine, theirs in zip(halved, found, strict=True):
        assert np.array_equal(mine, theirs)


@pytest.mark.parametrize("name", ["plain", "near_opaque", "behind_camera"])
def test_contribution(name: str) -> None:
    (means, quats, *constant), camera = make_scene(name)
    wanted = cpu.prepare(*constant).contribution(means, quats, camera)
    assert np.abs(warp_scene(*constant).contribution(means, quats, camera) - wanted).max() < 1e-5
    assert wanted.max() > 0.1


def test_colors_for_once() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("plain")
    other = 1 - colors
    wanted = cpu.prepare(scales, other, opacities).forward(means, quats, camera).image
    image = warp_scene(scales, colors, opacities).forward(means, quats, camera, colors=other).image
    assert np.abs(image - wanted).mean() < 1e-6


def test_nothing_to_draw_gives_the_background() -> None:
    camera = look_at((0, -3, 0), (0, 0, 0), size=(33, 40))
    scene = warp_scene(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    frame = scene.forward(np.zeros((0, 3)), np.zeros((0, 4)), camera, BACKGROUND)
    assert np.array_equal(frame.image, np.broadcast_to(BACKGROUND, (33, 40, 3)))
    assert not frame.alpha.any()
    assert scene.backward(frame, np.ones((33, 40, 3)))[0].shape == (0, 3)
    behind = warp_scene(np.ones((2, 3)), np.ones((2, 3)), np.ones(2))
    frame = behind.forward([[0, -9, 0], [0, -8, 0]], np.ones((2, 4)), camera, BACKGROUND)
    assert not frame.alpha.any()
    assert not behind.backward(frame, np.ones((33, 40, 3)))[0].any()


def test_broken_splats_are_left_out() -> None:
    (means, quats, scales, colors, opacities), camera = make_scene("plain")
    without = opacities.copy()
    without[:4] = 0
    image, _ = warp_scene(scales, colors, without).render(means, quats, camera)
    means[0], means[1], quats[2], quats[3] = np.nan, np.inf, 0, np.nan
    scene = warp_scene(scales, colors, opacities)
    broken = scene.forward(means, quats, camera)
    assert np.array_equal(broken.image, image)
    assert all(np.isfinite(g).all() for g in scene.backward(broken, np.ones_like(image)))


def test_wrong_shapes_are_refused() -> None:
    (means, quats, *constant), camera = make_scene("plain")
    scene = warp_scene(*constant)
    with pytest.raises(InputError, match="one row per splat"):
        scene.forward(means[1:], quats, camera)
    with pytest.raises(InputError, match="one size"):
        scene.render_and_grad_many(means[None], quats[None], [camera], [photometric_loss(np.zeros((8, 8, 3)))])
    with pytest.raises(InputError, match="belong together"):
        warp_scene(constant[0][1:], *constant[1:])


@pytest.mark.parametrize("module", ["project", "tiles", "blend", "loss_kernels"])
def test_kernels_compile_for_cuda(module: str, tmp_path: Path) -> None:
    """With Warp's own compiler, which needs no GPU; for the oldest architecture that Warp supports and torch too."""
    import importlib

    import warp

    built = warp.compile_aot_module(
        importlib.import_module(f"gskin_addon.core.render.warp.{module}"), arch=75, module_dir=tmp_path, use_ptx=True
    )
    code = built[0].read_bytes().decode(errors="replace")
    assert ".entry" in code
    assert ".local" not in code, "pixels of a thread left their registers"
    if module == "blend":
        assert "shfl.sync" in code
        assert "vote.sync" in code
