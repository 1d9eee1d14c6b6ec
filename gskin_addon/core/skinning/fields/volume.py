# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's weight volume (Sec. III-D): a CNN decodes it from one latent vector, as in HumanNeRF."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from numpy.typing import NDArray

from ...ticks import Tick, silent
from . import FIT_STEPS, RESOLUTION, WIDTH
from .base import WeightField
from .sparse import CORNERS, SparseProduct, trilinear_matrix, unit_cube
from .upsample import SparseUpsample, coarse_places

LATENT = 256
SLOPE = 0.2
"""Negative slope of the leaky ReLUs."""
RATE = 5e-4
"""Of a preset's learning rate, which is meant for logits; its 0.1 becomes 5e-5, HumanNeRF's rate for this decoder. Ten
times as much forgets the initial weights within ten steps and ends with one bone for each splat."""
FIT_RATE = 2e-3
FIT_ENOUGH = 0.01
"""Root mean square error of a weight at which L_init counts as minimised."""


class WeightVolume(WeightField):
    """softmax(trilinear(decoder(z)) + log prior), the decoder being HumanNeRF's (MIT licence).

    z (256 numbers) -> Linear -> `width` channels in 1 voxel -> transposed convolutions (kernel 4, stride 2,
    padding 1) with leaky ReLU 0.2 between them -> `resolution` voxels along each axis with one logit per bone.
    Only voxels that a splat reads, directly or through later layers, are computed.

    start "prior": the prior is the log of the initial weights and the last layer is zero, so that step 0
    equals the initial weights, as HumanNeRF does it. start "fit": as in the paper, without a prior; `fit` trains the
    decoder to reproduce the initial weights by L_init (Sec. III-D, Initialization).
    """

    def __init__(
        self,
        points: NDArray[Any],
        initial: NDArray[Any],
        resolution: int = RESOLUTION,
        width: int = WIDTH,
        start: str = "prior",
        fit_steps: int = FIT_STEPS,
        seed: int = 0,
    ) -> None:
        """points (N, 3) in any unit; initial (N, B) weights with rows that sum to 1; resolution: a power of 2.

        fit_steps: the most that `fit` takes. `check_options` says what else may be given.
        """
        super().__init__(initial)
        # The wider the decoder, the further a step of Adam moves its logits.
        self.rate = RATE * WIDTH / width
        self._fit_steps = 0
        if start == "fit":
            self._fit_steps = fit_steps
            self._prior = torch.zeros(())
        matrix, at = trilinear_matrix(unit_cube(points), resolution)
        self._interpolate = SparseProduct(matrix)
        layers: list[SparseUpsample] = []
        widths = [*decoder_widths(resolution, width), initial.shape[1]]
        for inputs, outputs in reversed(list(pairwise(widths))):
            coarse = resolution >> (len(layers) + 1)
            places = coarse_places(at, coarse) if coarse > 2 else CORNERS
            layers.append(SparseUpsample(at, places, coarse, inputs, outputs))
            at = places
        self.latent = torch.nn.Parameter(torch.empty(LATENT))
        self._expand = torch.nn.Linear(LATENT, width)
        # The first convolution makes 2^3 voxels from one: only 8 of its 64 taps ever read it.
        self._first = torch.nn.Linear(width, 8 * widths[0])
        layers.reverse()
        self._layers = torch.nn.ModuleList(layers)
        self._fill(layers, torch.Generator().manual_seed(seed))

    def residual(self) -> torch.Tensor:
        """Logits (N, B) read from the volume."""
        features = _leaky(self._first(_leaky(self._expand(self.latent)))).view(8, -1)
        for number, layer in enumerate(self._layers):
            features = layer(features if number == 0 else _leaky(features))
        logits: torch.Tensor = self._interpolate(features)
        return logits

    def fit(self, tick: Tick = silent) -> dict[str, float]:
        """Minimise L_init, the squared distance to the initial weights, averaged over the splats, by Adam, until the
        root mean square of a weight's error is `FIT_ENOUGH` or the steps are used up."""
        if not self._fit_steps:
            return {}
        initial = self.initial()
        adam = torch.optim.Adam(self.parameters(), lr=FIT_RATE, fused=True)
        steps, error = 0, math.inf
        while True:
            square = (self() - initial).square()
            error = float(square.detach().mean().sqrt())
            if error < FIT_ENOUGH or steps == self._fit_steps:
                break
            adam.zero_grad()
            square.sum(dim=1).mean().backward()
            adam.step()
            steps += 1
            tick(steps / self._fit_steps)
        return {"steps": steps, "error": error}

    def _fill(self, layers: list[SparseUpsample], generator: torch.Generator) -> None:
        """Random weights that keep the size of the features from layer to layer; zeros in the last."""
        with torch.no_grad():
            self.latent.normal_(generator=generator)
            for linear in (self._expand, self._first):
                linear.weight.normal_(0, _spread(linear.in_features), generator=generator)
                linear.bias.zero_()
            *hidden, last = (layer.weight for layer in layers)
            for weight in hidden:
                weight.normal_(0, _spread(weight.shape[1]), generator=generator)
            last.zero_()


def decoder_widths(resolution: int, width: int = WIDTH) -> list[int]:
    """Channels of the hidden grids of 2, 4, ... resolution / 2 voxels: 512-512-256-256-128-128 for 128."""
    return [max(1, width >> (level // 2 + 1)) for level in range(int(math.log2(resolution)) - 1)]


def create(
    points: NDArray[Any],
    initial: NDArray[Any],
    resolution: int = RESOLUTION,
    width: int = WIDTH,
    start: str = "prior",
    fit_steps: int = FIT_STEPS,
) -> WeightVolume:
    """See `WeightVolume`; width: channels of the decoder's first voxel (the paper's decoder: 1024)."""
    return WeightVolume(points, initial, resolution, width, start, fit_steps)


def _leaky(x: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.leaky_relu(x, SLOPE)


def _spread(inputs: int) -> float:
    return math.sqrt(2.0 / (1.0 + SLOPE**2) / inputs)

