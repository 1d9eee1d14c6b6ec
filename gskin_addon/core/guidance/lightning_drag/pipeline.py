# SPDX-License-Identifier: GPL-3.0-or-later
"""LightningDrag's sampling: a rest view, numbered control points and a mask in, the posed view out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from ..diffusion import Frame, Tick, generator
from .appearance import appearance_bank
from .image_tokens import clip_pixels
from .point_maps import check_size, farthest_points, point_maps
from .processors import Guide
from .schedule import FIRST_TIMESTEP, Schedule
from .weights import LightningDrag


@dataclass(frozen=True)
class View:
    """What the encoders make of one rest view.

    latents (1, 4, h, w): of the image, scaled; bank: one tensor (1, T, hidden) per self-attention; tokens
    (1, 4, width): of the image.
    """

    latents: torch.Tensor
    bank: list[torch.Tensor]
    tokens: torch.Tensor


class LightningDragPainter:
    """See `diffusion.Painter`."""

    def __init__(
        self,
        model: LightningDrag,
        schedule: Schedule,
        *,
        device: torch.device,
        dtype: torch.dtype,
        batch: int = 1,
        max_points: int = 0,
        offload: bool = False,
    ) -> None:
        """max_points: control points kept, 0 for all; offload: keep the encoders off the device but for their
        one pass per view."""
        self.model, self.schedule, self.batch = model, schedule, batch
        self._device, self._dtype = device, dtype
        self._max_points, self._offload = max_points, offload
        self._seen: tuple[int, View] | None = None
        self._text = model.text.to(device, dtype)
        for module in model.denoisers if offload else (*model.denoisers, *model.encoders):
            module.to(device)

    @torch.no_grad()
    def paint(self, frames: Sequence[Frame], tick: Tick) -> Sequence[NDArray[Any]]:
        """See Painter: images (H, W, 3) float32 in [0, 1], not yet composited."""
        height, width = frames[0].mask.shape
        check_size(height, width)
        view = self._view(frames[0])
        # One stream of random numbers per image, on the CPU: the same whatever the device and the batch.
        streams = [generator(frame) for frame in frames]
        mask, masked = self._masked(frames, streams)
        guide = self._guide(frames, view)
        scheduler = self.schedule.scheduler(self.model.scheduler, self._device)
        noise = torch.cat([torch.randn(view.latents.shape, generator=stream) for stream in streams])
        latents = add_noise(scheduler, view.latents, noise.to(self._device))
        text = self._text.expand(2 * len(frames), -1, -1)
        for step, timestep in enumerate(scheduler.timesteps):
            seen = torch.cat([latents.to(self._dtype), mask, masked], dim=1)
            noise = self.model.unet(
                torch.cat([seen, seen]),
                timestep,
                encoder_hidden_states=text,
                cross_attention_kwargs={"guide": guide},
                return_dict=False,
            )[0]
            without, shown = noise.float().chunk(2)
            noise = without + self.schedule.scale_at(step) * (shown - without)
            more = {"generator": streams} if self.schedule.kind == "lcm" else {}
            latents = scheduler.step(noise, timestep, latents, return_dict=False, **more)[0]
            tick((step + 1) / (self.schedule.steps + 1))
        return self._decode(latents)

    def _view(self, frame: Frame) -> View:
        """The encoders' one pass over the rest view of `frame`."""
        if self._seen is not None and self._seen[0] == frame.signal.view:
            return self._seen[1]
        self._move_encoders(self._device)
        # The posterior's noise belongs to the view, which the images of any batch share.
        stream = torch.Generator("cpu").manual_seed(frame.signal.view)
        latents = encode(self.model.vae, self._pixels(frame.rest), [stream])
        side = self.model.image_encoder.config.image_size
        pixels = clip_pixels(frame.rest, side).to(self._device, self._dtype)
        tokens = self.model.image_tokens(self.model.image_encoder(pixels).image_embeds)
        bank = appearance_bank(self.model.appearance, latents.to(self._dtype), self._text, self.model.places)
        if self._offload:
            self._move_encoders(torch.device("cpu"))
        view = View(latents, bank, tokens)
        self._seen = (frame.signal.view, view)
        return view

    def _move_encoders(self, device: torch.device) -> None:
        if self._offload:
            for module in self.model.encoders:
                module.to(device)

    def _masked(self, frames: Sequence[Frame], streams: list[torch.Generator]) -> tuple[torch.Tensor, torch.Tensor]:
        """Masks (B, 1, h, w) at the latents' size and the latents (B, 4, h, w) of the images without what they
        cover."""
        mask = torch.from_numpy(np.stack([frame.mask for frame in frames])).to(self._device, self._dtype)[:, None]
        image = torch.cat([self._pixels(frame.rest) for frame in frames]) * (mask < 0.5)
        latents = encode(self.model.vae, image, streams)
        return functional.interpolate(mask, size=latents.shape[-2:], mode="nearest"), latents.to(self._dtype)

    def _guide(self, frames: Sequence[Frame], view: View) -> Guide:
        """For 2 B latents: the first half does not see the points, the second does."""
        maps = []
        for frame in frames:
            points = farthest_points(frame.signal.handles, frame.signal.targets, self._max_points)
            maps.append(point_maps(*points, *frame.mask.shape))
        handles, targets = self.model.point_embedding(torch.from_numpy(np.stack(maps)).to(self._device, self._dtype))
        shown = torch.tensor([0.0, 1.0]).repeat_interleave(len(frames)).to(self._device, self._dtype)[:, None, None]
        twice = [[torch.cat([x, x]) for x in level] for level in (handles, targets)]
        return Guide(view.bank, view.tokens, twice[0], twice[1], shown)

    def _pixels(self, image: NDArray[Any]) -> torch.Tensor:
        return to_pixels(image).to(self._device, self._dtype)

    def _decode(self, latents: torch.Tensor) -> list[NDArray[Any]]:
        vae = self.model.vae
        decoded = vae.decode(latents.to(self._dtype) / vae.config.scaling_factor, return_dict=False)[0]
        images = (decoded.float() / 2 + 0.5).clamp(0, 1).permute(0, 2, 3, 1)
        return list(images.cpu().numpy())


def to_pixels(image: NDArray[Any]) -> torch.Tensor:
    """An image (H, W, 3) in [0, 1] as the VAE takes it: (1, 3, H, W) float32 in [-1, 1]."""
    return torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None] * 2 - 1


def encode(vae: Any, pixels: torch.Tensor, streams: list[torch.Generator]) -> torch.Tensor:
    """Scaled samples (B, 4, h, w) float32 of the VAE's posterior; one stream of random numbers per image."""
    posterior = vae.encode(pixels).latent_dist
    sample = posterior.sample(generator=streams) if len(streams) > 1 else posterior.sample(generator=streams[0])
    return sample.float() * vae.config.scaling_factor


def add_noise(scheduler: Any, latents: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Where sampling starts: the source's latents, noised as at the last timestep of training."""
    timesteps = torch.full((len(noise),), FIRST_TIMESTEP, device=noise.device, dtype=torch.long)
    return scheduler.add_noise(latents.expand_as(noise), noise, timesteps)
