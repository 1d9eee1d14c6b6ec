# SPDX-License-Identifier: GPL-3.0-or-later
"""The painter's sampling against numbers that an independent numpy version of the published formulas gave.

The original was not run for them; its schedulers are those of diffusers, which the formulas are held to here too.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn import functional

pytest.importorskip("diffusers")

from gskin_addon.core.guidance.control import ControlSignal
from gskin_addon.core.guidance.diffusion import Frame
from gskin_addon.core.guidance.lightning_drag.pipeline import LightningDragPainter, Schedule
from gskin_addon.core.guidance.lightning_drag.weights import LightningDrag
from gskin_addon.core.render.camera import look_at
from tests.helpers import sampler_reference as reference

CPU = torch.device("cpu")
CONFIG = {**reference.BETAS, "steps_offset": 1}


@pytest.fixture(scope="module")
def numbers():
    return json.loads(reference.NUMBERS.read_text())


@dataclass
class Posterior:
    mean: torch.Tensor

    def sample(self, generator):
        streams = generator if isinstance(generator, list) else [generator]
        noise = torch.cat([torch.randn((1, *self.mean.shape[1:]), generator=stream) for stream in streams])
        return self.mean + reference.DEVIATION * noise


class TinyModel:
    """`reference.Tiny` in torch, in the shape of the painter's models; keeps the latents that are decoded."""

    def __init__(self):
        for name, value in vars(reference.tiny()).items():
            setattr(self, name, torch.tensor(value, dtype=torch.float32))
        self.decoded = None

    def encode_pixels(self, pixels):
        mean = torch.einsum("kc,bcyx->bkyx", self.encode, functional.avg_pool2d(pixels, 8))
        return SimpleNamespace(latent_dist=Posterior(mean))

    def decode(self, latents, return_dict):
        self.decoded = latents * reference.SCALING
        return (functional.interpolate(latents[:, :3], scale_factor=8.0),)

    def points(self, maps):
        small = 64 * functional.avg_pool2d(maps, 8)
        return tuple([small[:, k].flatten(1)[..., None]] for k in range(2))

    def predict(self, nine, timestep, encoder_hidden_states, cross_attention_kwargs, return_dict):
        guide, side = cross_attention_kwargs["guide"], nine.shape[-1]
        inner = torch.einsum("kc,bcyx->bkyx", self.noise, nine)
        inner = inner + torch.cos(timestep / 200) * self.beat[:, None, None]
        added = guide.handles[0] * self.handle + guide.targets[0] * self.target  # (B, T, 4)
        added = (added * guide.shown).transpose(1, 2).unflatten(2, (side, side))
        return (nine[:, :4] + reference.EFFECT * (torch.tanh(inner) + added),)

    def models(self):
        vae = SimpleNamespace(
            encode=self.encode_pixels, decode=self.decode, config=SimpleNamespace(scaling_factor=reference.SCALING)
        )
        seer = Stub(lambda pixels: SimpleNamespace(image_embeds=pixels.mean((1, 2, 3))[:, None]))
        seer.config = SimpleNamespace(image_size=28)
        return LightningDrag(
            unet=Stub(self.predict),
            processors=torch.nn.ModuleList(),
            point_embedding=Stub(self.points),
            appearance=Stub(lambda *_, **__: None),
            image_encoder=seer,
            image_tokens=Stub(lambda embeds: embeds),
            vae=Movable(vae),
            text=torch.zeros(1, 77, 4),
            places=[],
            scheduler=CONFIG,
        )


class Stub(torch.nn.Module):
    def __init__(self, forward):
        super().__init__()
        self.forward = forward


class Movable(SimpleNamespace):
    def __init__(self, inner):
        super().__init__(**vars(inner))

    def to(self, _device):
        return self


def frames():
    scene, camera = reference.scene(), look_at((0, -1, 0), (0, 0, 0), size=(reference.SIDE, reference.SIDE))
    rest = scene["rest"].astype(np.float32)
    return [
        Frame(ControlSignal(reference.VIEW, camera, np.zeros((0, 4, 4)), handles, targets), rest, rest, mask, seed)
        for mask, handles, targets, seed in zip(
            scene["masks"], scene["handles"], scene["targets"], reference.SEEDS, strict=True
        )
    ]


@pytest.mark.parametrize("kind", ["ddim", "lcm"])
@pytest.mark.parametrize("together", [True, False])
def test_sampling_gives_the_recorded_numbers(numbers, kind, together):
    """DDIM with 25 steps, LCM with 8: alone or in a batch, the latents within 1e-5."""
    tiny, found = TinyModel(), []
    painter = LightningDragPainter(tiny.models(), Schedule.of(kind), device=CPU, dtype=torch.float32, batch=2)
    for group in [frames()] if together else [[frame] for frame in frames()]:
        painter.paint(group, lambda _done: None)
        found.extend(tiny.decoded.flatten(1).numpy())
    np.testing.assert_allclose(found, numbers["latents"][kind], atol=1e-5, rtol=0)
    assert np.std(found) > 0.1


@pytest.mark.parametrize("kind", ["ddim", "lcm"])
def test_the_numbers_are_those_of_the_formulas(numbers, kind):
    fresh = reference.numbers()
    np.testing.assert_allclose(fresh["draws"][kind], numbers["draws"][kind], atol=1e-6)  # else: another torch's
    np.testing.assert_allclose(fresh["latents"][kind], numbers["latents"][kind], atol=1e-8)


@pytest.mark.parametrize(("kind", "steps"), [("ddim", 25), ("ddim", 10), ("lcm", 8), ("lcm", 4), ("lcm", 7)])
def test_the_formulas_are_those_of_diffusers_schedulers(kind, steps):
    rng = np.random.default_rng(0)
    scheduler = Schedule.of(kind, steps).scheduler(CONFIG, CPU)
    wanted = reference.ddim_timesteps(steps) if kind == "ddim" else reference.lcm_timesteps(steps)
    assert scheduler.timesteps.tolist() == wanted
    np.testing.assert_allclose(scheduler.alphas_cumprod, reference.alphas(), rtol=2e-5)
    x = rng.normal(size=(1, 4, 8, 8))
    theirs = torch.tensor(x)
    stream = torch.Generator().manual_seed(3)
    same = torch.Generator().manual_seed(3)
    for step, t in enumerate(wanted):
        noise = rng.normal(size=x.shape)
        more = {"generator": stream} if kind == "lcm" else {}
        theirs = scheduler.step(torch.tensor(noise), t, theirs, **more).prev_sample
        if kind == "ddim":
            x = reference.ddim_step(x, noise, t, steps, reference.alphas())
        else:
            following = None if step == steps - 1 else wanted[step + 1]
            fresh = None if following is None else torch.randn(x.shape, generator=same, dtype=torch.float64).numpy()
            x = reference.lcm_step(x, noise, t, following, fresh, reference.alphas())
        np.testing.assert_allclose(theirs, x, rtol=1e-4, atol=1e-5 * np.abs(x).max())
