# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from gskin_addon.core.errors import InputError
from gskin_addon.core.render import reference
from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.cpu import CpuScene, morton_order, prepare
from gskin_addon.core.render.rasterizer import rasterize, resolve_backend

_spec = importlib.util.spec_from_file_location("render_scenes", Path(__file__).with_name("scenes.py"))
assert _spec is not None
assert _spec.loader is not None
_scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_scenes)
SCENES, make_scene = _scenes.SCENES, _scenes.make_scene

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
    image, alpha = reference.render(m, q, *map(torch.tensor, (scales, colors, opacities)), camera,
                                    torch.tensor(BACKGROUND), compensate=compensate)
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
