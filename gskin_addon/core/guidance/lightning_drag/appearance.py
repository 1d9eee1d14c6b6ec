# SPDX-License-Identifier: GPL-3.0-or-later
"""The appearance encoder: a UNet that reads the source image once and leaves its tokens, the "bank"."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

_UNUSED_TOP = ("conv_norm_out", "conv_out")
_UNUSED_IN_BLOCK = ("attn1", "norm2", "attn2", "norm3", "ff")


def last_attention(unet: Any) -> tuple[str, Any]:
    """Name and module of the transformer after whose first norm nothing of the encoder is read."""
    number = len(unet.up_blocks) - 1
    place = len(unet.up_blocks[number].attentions) - 1
    return f"up_blocks.{number}.attentions.{place}", unet.up_blocks[number].attentions[place]


def absent_keys(unet: Any) -> set[str]:
    """The keys of a stock `unet` that a published appearance encoder lacks: 24 of Stable Diffusion 1.5's 686."""
    name, _ = last_attention(unet)
    prefixes = [f"{top}." for top in _UNUSED_TOP] + [f"{name}.proj_out."]
    prefixes += [f"{name}.transformer_blocks.0.{part}." for part in _UNUSED_IN_BLOCK]
    return {key for key in unet.state_dict() if key.startswith(tuple(prefixes))}


class _Nothing(nn.Module):
    """Replaces a part whose output is not used."""

    def forward(self, x: torch.Tensor, *_: Any, **__: Any) -> torch.Tensor:
        return torch.zeros_like(x)


def prune(unet: Any) -> None:
    """Take away what `absent_keys` names, so that `unet` holds the checkpoint's tensors and no others."""
    _, transformer = last_attention(unet)
    block = transformer.transformer_blocks[0]
    block.attn1, block.ff, block.attn2 = _Nothing(), _Nothing(), None
    block.norm2, block.norm3, transformer.proj_out = nn.Identity(), nn.Identity(), nn.Identity()
    unet.conv_norm_out, unet.conv_out = None, nn.Identity()


def appearance_bank(encoder: Any, latents: torch.Tensor, text: torch.Tensor, places: list[str]) -> list[torch.Tensor]:
    """The inputs of the self-attentions called `places`, in that order, each (B, T, hidden).

    latents (B, 4, h, w) of the source without noise; text (1 or B, 77, width) of the empty prompt; timestep 0.
    """
    found: dict[str, torch.Tensor] = {}
    handles = []
    for place in places:
        norm = encoder.get_submodule(place.removesuffix("attn1") + "norm1")

        def keep(_module: nn.Module, _inputs: Any, output: torch.Tensor, place: str = place) -> None:
            found[place] = output

        handles.append(norm.register_forward_hook(keep))
    try:
        encoder(latents, 0, encoder_hidden_states=text.expand(len(latents), -1, -1), return_dict=False)
    finally:
        for handle in handles:
            handle.remove()
    return [found[place] for place in places]
