# SPDX-License-Identifier: GPL-3.0-or-later
"""LightningDrag's sampling once more, in numpy and float64, from the published formulas and nobody's code.

DDIM: Song et al. 2021, Eq. 12 without noise. LCM: Luo et al. 2023, Eq. 8 to 10 and the multistep sampling of their
Algorithm 3, with sigma_data 0.5 and timesteps scaled by 10, 50 steps of the teacher. Guidance of the points: its
authors' inverse-square decay. The "models" are small formulas (`Tiny`), so that all of a sampling can be written down.

`python tests/helpers/sampler_reference.py` writes the numbers that `test_sampler_numbers.py` holds the painter to.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NUMBERS = Path(__file__).parents[1] / "core/guidance/lightning_drag/sampler_numbers.json"
SIDE, VIEW, SEEDS = 64, 5, (11, 12)
BETAS = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
SCALING = 0.18215
DEVIATION = 0.1
EFFECT = 0.05


@dataclass(frozen=True)
class Tiny:
    """The weights of all models, from a formula: no file, no generator.

    encode (4, 3): the VAE's mean of a latent from the mean colour of its 8 x 8 pixels, in [-1, 1]; noise (4, 9): of
    the UNet's nine channels; beat (4,): of the timestep; handle, target (4,): of the numbers in a latent's pixels.
    """

    encode: Array
    noise: Array
    beat: Array
    handle: Array
    target: Array


def tiny() -> Tiny:
    """The models of the fixture."""
    return Tiny(
        encode=np.sin(np.arange(12.0)).reshape(4, 3),
        noise=0.6 * np.cos(1.7 * np.arange(36.0)).reshape(4, 9),
        beat=np.array([0.3, -0.2, 0.1, 0.4]),
        handle=np.array([0.5, -0.4, 0.3, 0.2]),
        target=np.array([-0.3, 0.6, 0.2, -0.5]),
    )


def scene() -> dict[str, Array]:
    """Inputs: rest (64, 64, 3) a smooth picture; masks (2, 64, 64) bool, a box and a disc; handles, targets (2, 3, 2)
    pixel positions (x, y), of which the last target of the second image lies outside."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    rest = np.stack([0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(7 * y), 0.5 + 0.3 * np.sin(6 * (x - y))], axis=-1)
    box = (x > 0.2) & (x < 0.7) & (y > 0.3) & (y < 0.9)
    disc = (x - 0.5) ** 2 + (y - 0.4) ** 2 < 0.09
    handles = np.array([[[20, 30], [40.5, 50], [8, 8]], [[33, 20], [30, 30.9], [60, 60]]], float)
    targets = np.array([[[25, 30], [42, 40.2], [9, 17]], [[33, 28], [50, 33], [70, 60]]], float)
    return {"rest": rest, "masks": np.stack([box, disc]), "handles": handles, "targets": targets}


def cells(values: Array) -> Array:
    """Means (..., 8, 8) of the 8 x 8 pixels of each latent of (..., 64, 64)."""
    return values.reshape(*values.shape[:-2], SIDE // 8, 8, SIDE // 8, 8).mean(axis=(-3, -1))


def alphas() -> Array:
    """Cumulated alphas (1000,) of Stable Diffusion's noise schedule."""
    betas = np.linspace(BETAS["beta_start"] ** 0.5, BETAS["beta_end"] ** 0.5, 1000) ** 2
    return np.cumprod(1 - betas)


def guidance(first: float, step: int, steps: int) -> float:
    return (first - 1) * (1 - step / steps) ** 2 + 1


def ddim_timesteps(steps: int) -> list[int]:
    """Every 1000 / steps from 1, the last first."""
    return [step * (1000 // steps) + 1 for step in range(steps)][::-1]


def lcm_timesteps(steps: int) -> list[int]:
    """`steps` of the teacher's 50 (19, 39, ... 999), evenly spread from the last."""
    teacher = [20 * (k + 1) - 1 for k in range(50)][::-1]
    return [teacher[int(np.floor(50 * k / steps))] for k in range(steps)]


def ddim_step(x: Array, noise: Array, t: int, steps: int, cumulated: Array) -> Array:
    before = t - 1000 // steps
    a, b = cumulated[t], cumulated[max(before, 0)]
    clean = (x - np.sqrt(1 - a) * noise) / np.sqrt(a)
    return np.sqrt(b) * clean + np.sqrt(1 - b) * noise


def lcm_step(x: Array, noise: Array, t: int, following: int | None, fresh: Array | None, cumulated: Array) -> Array:
    a = cumulated[t]
    clean = (x - np.sqrt(1 - a) * noise) / np.sqrt(a)
    scaled = 10.0 * t
    skip, out = 0.25 / (scaled**2 + 0.25), scaled / np.sqrt(scaled**2 + 0.25)
    consistent = out * clean + skip * x
    if following is None:
        return consistent
    b = cumulated[following]
    return np.sqrt(b) * consistent + np.sqrt(1 - b) * fresh


def point_cells(model: Tiny, handles: Array, targets: Array) -> Array:
    """What the points add (4, 8, 8): 64 times the mean of their numbered pixels, by the weights."""
    maps = np.zeros((2, SIDE, SIDE))
    number = 0
    for (hx, hy), (tx, ty) in zip(handles, targets, strict=True):
        if all(0 <= c < SIDE for c in (hx, hy, tx, ty)):
            number += 1
            maps[0, int(hy), int(hx)] = number
            maps[1, int(ty), int(tx)] = number
    small = 64 * cells(maps)
    return model.handle[:, None, None] * small[0] + model.target[:, None, None] * small[1]


def predict(model: Tiny, nine: Array, t: int, points: Array | None) -> Array:
    """The noise (4, 8, 8) that the UNet predicts for its nine channels (9, 8, 8): most of what it sees is noise."""
    inner = np.einsum("kc,cyx->kyx", model.noise, nine) + np.cos(t / 200) * model.beat[:, None, None]
    return nine[:4] + EFFECT * (np.tanh(inner) + (0 if points is None else points))


def sample(kind: str, image: int, draws: dict[str, Any]) -> Array:
    """The latents (4, 8, 8) that sampling ends with, scaled, for image 0 or 1 of the scene.

    draws: standard normal numbers (4, 8, 8): "view" and "masked" of the VAE's two posteriors, "start", and "steps" of
    LCM, one for each step but the last.
    """
    model, given, cumulated = tiny(), scene(), alphas()
    steps, first = (25, 4.0) if kind == "ddim" else (8, 3.0)
    picture = given["rest"].transpose(2, 0, 1) * 2 - 1
    mask = given["masks"][image].astype(float)

    def encoded(pixels: Array, noise: Array) -> Array:
        mean = np.einsum("kc,cyx->kyx", model.encode, cells(pixels))
        return SCALING * (mean + DEVIATION * noise)

    source = encoded(picture, draws["view"])
    masked = encoded(picture * (mask < 0.5), draws["masked"])
    small = mask[None, ::8, ::8]  # nearest: the first pixel of eight
    points = point_cells(model, given["handles"][image], given["targets"][image])
    x = np.sqrt(cumulated[999]) * source + np.sqrt(1 - cumulated[999]) * draws["start"]
    timesteps = ddim_timesteps(steps) if kind == "ddim" else lcm_timesteps(steps)
    for step, t in enumerate(timesteps):
        nine = np.concatenate([x, small, masked])
        without, shown = predict(model, nine, t, None), predict(model, nine, t, points)
        noise = without + guidance(first, step, steps) * (shown - without)
        if kind == "ddim":
            x = ddim_step(x, noise, t, steps, cumulated)
        else:
            last = step == steps - 1
            following, fresh = (None, None) if last else (timesteps[step + 1], draws["steps"][step])
            x = lcm_step(x, noise, t, following, fresh, cumulated)
    return x


def torch_draws(image: int, steps: int) -> dict[str, Any]:
    """The random numbers of an image as the painter draws them: float32 on the CPU, a stream for the view and one
    for each image, from which come the masked picture's, the start's and the steps'."""
    import torch

    shape = (1, 4, SIDE // 8, SIDE // 8)
    view, own = (torch.Generator("cpu").manual_seed(seed) for seed in (VIEW, SEEDS[image]))
    draws: dict[str, Any] = {"view": torch.randn(shape, generator=view)}
    draws |= {name: torch.randn(shape, generator=own) for name in ("masked", "start")}
    draws["steps"] = [torch.randn(shape, generator=own) for _ in range(steps)]
    return {
        name: [v[0].double().numpy() for v in value] if isinstance(value, list) else value[0].double().numpy()
        for name, value in draws.items()
    }


def numbers() -> dict[str, Any]:
    """What the fixture holds: for both samplers the latents of both images, and the draws' first numbers, which tell
    whether another torch draws others."""
    found: dict[str, Any] = {"made": __doc__, "draws": {}, "latents": {}}
    for kind, steps in (("ddim", 0), ("lcm", 7)):
        drawn = [torch_draws(image, steps) for image in range(2)]
        found["latents"][kind] = [np.round(sample(kind, i, d), 9).ravel().tolist() for i, d in enumerate(drawn)]
        found["draws"][kind] = [
            [float(np.round(d[name].flat[0], 7)) for name in ("view", "masked", "start")]
            + [float(np.round(step.flat[0], 7)) for step in d["steps"]]
            for d in drawn
        ]
    return found


if __name__ == "__main__":
    NUMBERS.write_text(json.dumps(numbers(), indent=1) + "\n", encoding="utf-8")
