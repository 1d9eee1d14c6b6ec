# SPDX-License-Identifier: GPL-3.0-or-later
"""LightningDrag's training loss: the error of the predicted noise at a random timestep."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from ...guidance.lightning_drag.appearance import appearance_bank
from ...guidance.lightning_drag.pipeline import Schedule, encode
from ...guidance.lightning_drag.processors import Guide
from ...guidance.lightning_drag.weights import LightningDrag
from .examples import PairBatch


class DragLoss(nn.Module):
    """All models as one module, whose forward is the loss of a batch."""

    def __init__(self, model: LightningDrag, drop: float, device: torch.device, dtype: torch.dtype) -> None:
        """drop: part of the examples that do not see their points; dtype: of the weights that do not train."""
        super().__init__()
        self.unet, self.appearance, self.points = model.unet, model.appearance, model.point_embedding
        self.vae, self.image_encoder, self.image_tokens = model.vae, model.image_encoder, model.image_tokens
        self._places, self._drop, self._device, self._dtype = model.places, drop, device, dtype
        self._text = model.text.to(device, dtype)
        self._scheduler = Schedule.of("ddim").scheduler(model.scheduler, device)

    def forward(self, batch: PairBatch) -> torch.Tensor:
        """Mean squared error over the batch, a scalar."""
        # One stream of random numbers per example, on the CPU: the same in whatever batch and on whatever device.
        streams = [torch.Generator("cpu").manual_seed(seed) for seed in batch.seeds]
        count, steps = len(streams), self._scheduler.config.num_train_timesteps
        timesteps = torch.cat([torch.randint(steps, (1,), generator=stream) for stream in streams]).to(self._device)
        kept = torch.cat([torch.rand(1, generator=stream) for stream in streams]) >= self._drop
        rest, posed = self._to(batch.rest), self._to(batch.posed)
        mask = self._to(batch.mask)
        with torch.no_grad():
            goal = encode(self.vae, posed, streams)
            source = encode(self.vae, rest, streams)
            masked = encode(self.vae, rest * (mask < 0.5), streams)
            tokens = self.image_tokens(self.image_encoder(self._to(batch.clip)).image_embeds)
        noise = torch.cat([torch.randn(1, *goal.shape[1:], generator=stream) for stream in streams]).to(self._device)
        noisy = self._scheduler.add_noise(goal, noise, timesteps)
        small = functional.interpolate(mask, size=goal.shape[-2:], mode="nearest")
        text = self._text.expand(count, -1, -1)
        bank = appearance_bank(self.appearance, self._to(source), text, self._places)
        handles, targets = self.points(self._to(batch.maps))
        guide = Guide(bank, tokens, handles, targets, self._to(kept)[:, None, None])
        predicted = self.unet(
            torch.cat([self._to(noisy), small, self._to(masked)], dim=1),
            timesteps,
            encoder_hidden_states=text,
            cross_attention_kwargs={"guide": guide},
            return_dict=False,
        )[0]
        return functional.mse_loss(predicted.float(), noise)

    def _to(self, values: Any) -> torch.Tensor:
        moved: torch.Tensor = values.to(self._device, self._dtype)
        return moved


def trained_parameters(model: LightningDrag) -> dict[str, nn.Parameter]:
    """What is trained: point embedding, self-attentions' norms and projections, and the appearance encoder.

    Assumed from what LightningDrag's paper describes (Shi et al. 2024); its repository is for inference only, and
    G-Skin does not say which parameters its fine-tuning changes. The rest stays as it is.
    """
    parts = {"points": model.point_embedding, "appearance": model.appearance}
    found = {f"{part}.{name}": value for part, module in parts.items() for name, value in module.named_parameters()}
    for number in range(0, len(model.processors), 2):
        for name, value in model.processors[number].named_parameters():
            found[f"attention.{number}.{name}"] = value
    return found
