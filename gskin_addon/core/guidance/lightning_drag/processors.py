# SPDX-License-Identifier: GPL-3.0-or-later
"""LightningDrag's attention (Shi et al. 2024) as two processors on a stock diffusers UNet2DConditionModel.

Saved as a ModuleList in the order of `unet.attn_processors` (down, up, mid): even numbers are the
self-attentions `{i}.norm.weight`, `{i}.norm.bias`, `{i}.proj.weight`, odd ones the cross-attentions
`{i}.to_k_ip.weight`, `{i}.to_v_ip.weight`; 80 tensors for the 32 attentions of Stable Diffusion 1.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from ...errors import InputError

SELF_ATTENTION = "attn1"


@dataclass(frozen=True)
class Guide:
    """What the attentions of one batch of B latents are shown; passed as `cross_attention_kwargs`.

    bank: for each self-attention, in the processors' order, the reference's tokens (B or 1, T, hidden);
    image_tokens (B or 1, 4, text width); handles, targets: the point embeddings of each resolution, fine to
    coarse, (B, T, E); shown (B, 1, 1): 1 where the points count, 0 where they must have no effect at all.
    """

    bank: Sequence[torch.Tensor]
    image_tokens: torch.Tensor
    handles: Sequence[torch.Tensor]
    targets: Sequence[torch.Tensor]
    shown: torch.Tensor


class PointSelfAttention(nn.Module):
    """Self-attention that also looks at the reference, steered by the points.

    With x the tokens, r the reference's, t = proj(norm(target)), h = proj(norm(handle)):
    Q = Wq x + t, K = Wk [x, r] + [t, h], V = Wv [x, r].
    """

    def __init__(self, hidden: int, embedding: int, place: int, level: int) -> None:
        """place: which tensor of the bank is this attention's; level: its resolution, 0 the finest."""
        super().__init__()
        self.norm = nn.LayerNorm(embedding)
        self.proj = nn.Linear(embedding, hidden, bias=False)
        self.place, self.level = place, level

    def __call__(
        self,
        attn: Any,
        hidden_states: torch.Tensor,
        encoder_hidden_states: torch.Tensor | None = None,
        attention_mask: torch.Tensor | None = None,
        *,
        guide: Guide,
    ) -> torch.Tensor:
        """hidden_states (B, T, hidden) -> the same; diffusers reads this signature to know its arguments."""
        reference = guide.bank[self.place].to(hidden_states.dtype).expand(len(hidden_states), -1, -1)
        target = self._project(guide.targets[self.level], guide.shown, hidden_states)
        handle = self._project(guide.handles[self.level], guide.shown, hidden_states)
        both = torch.cat([hidden_states, reference], dim=1)
        query = attn.to_q(hidden_states) + target
        key = attn.to_k(both) + torch.cat([target, handle], dim=1)
        return _out(attn, _attend(attn.heads, query, key, attn.to_v(both)))

    def _project(self, embedding: torch.Tensor, shown: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
        projected: torch.Tensor = self.proj(self.norm(embedding.to(self.proj.weight.dtype)))
        # Zeroed after the norm, whose bias would otherwise be an effect of points that are not there.
        return projected.to(like.dtype) * shown.to(like.dtype)


class ImageCrossAttention(nn.Module):
    """Cross-attention to the text, plus 1.0 x attention to the tokens of the source image (IP-Adapter)."""

    def __init__(self, hidden: int, context: int) -> None:
        super().__init__()
        self.to_k_ip = nn.Linear(context, hidden, bias=False)
        self.to_v_ip = nn.Linear(context, hidden, bias=False)

    def __call__(
        self,
        attn: Any,
        hidden_states: torch.Tensor,
        encoder_hidden_states: torch.Tensor | None = None,
        attention_mask: torch.Tensor | None = None,
        *,
        guide: Guide,
    ) -> torch.Tensor:
        """hidden_states (B, T, hidden), encoder_hidden_states (B, 77, text width) -> (B, T, hidden)."""
        query = attn.to_q(hidden_states)
        text = _attend(attn.heads, query, attn.to_k(encoder_hidden_states), attn.to_v(encoder_hidden_states))
        tokens = guide.image_tokens.to(self.to_k_ip.weight.dtype).expand(len(hidden_states), -1, -1)
        image = _attend(attn.heads, query, self.to_k_ip(tokens), self.to_v_ip(tokens))
        return _out(attn, text + image)


def _attend(heads: int, query: torch.Tensor, key: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Multi-head attention (B, T, hidden) before the output projection."""
    q, k, v = (x.reshape(*x.shape[:2], heads, -1).transpose(1, 2) for x in (query, key, value))
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def _out(attn: Any, tokens: torch.Tensor) -> torch.Tensor:
    for layer in attn.to_out:
        tokens = layer(tokens)
    return tokens


def level_of(name: str, levels: int) -> int:
    """Resolution of the attention called `name` in a UNet with `levels` of them; 0 is the finest."""
    part, number = name.split(".")[:2]
    if part == "mid_block":
        return levels - 1
    return int(number) if part == "down_blocks" else levels - 1 - int(number)


def install(unet: Any, embeddings: Sequence[int]) -> nn.ModuleList:
    """Give `unet` processors with new weights and return them in the published order.

    embeddings: width E of the point embedding at each resolution, fine to coarse (128, 256, 512, 1024).

    Raises:
        InputError: the UNet has another number of resolutions.
    """
    widths = unet.config.block_out_channels
    if len(widths) != len(embeddings):
        raise InputError(
            f"The base model's UNet has {len(widths)} resolutions and the point embedding {len(embeddings)}; "
            "choose a Stable Diffusion 1.5 inpainting model."
        )
    processors: dict[str, nn.Module] = {}
    place = 0
    for name in unet.attn_processors:
        level = level_of(name, len(widths))
        if name.split(".")[-2] == SELF_ATTENTION:
            processors[name] = PointSelfAttention(widths[level], embeddings[level], place, level)
            place += 1
        else:
            processors[name] = ImageCrossAttention(widths[level], unet.config.cross_attention_dim)
    unet.set_attn_processor(dict(processors))
    return nn.ModuleList(processors.values())


def self_attentions(unet: Any) -> list[str]:
    """Module names of the self-attentions, in the processors' order, which is the bank's."""
    names = [name.removesuffix(".processor") for name in unet.attn_processors]
    return [name for name in names if name.endswith(SELF_ATTENTION)]
