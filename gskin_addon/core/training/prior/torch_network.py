# SPDX-License-Identifier: GPL-3.0-or-later
"""The network for training: core/skinning/learned/network.py with gradients, for several bodies at once. Both have the
same parameters with the same names; a test compares their outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ...skinning.learned.features import PRIOR
from ...skinning.learned.network import DOUBT, FAR, POOLS, SHARPEST, Shape
from ...skinning.learned.tree import RELATIONS


@dataclass
class BodyBatch:
    """Descriptions of one or more bodies, splats in a row.

    bone (N, K) int64, -1 where there is none; role (N, K) int64, see `bone_roles`; values (N, K, F); kin (N, K, K)
    int64 relation of the token in the column to the one in the row; bodies: for each body its slice of splats, number
    of bones, neighbourhoods (n, k) and labels (n, 3) within the slice.
    """

    bone: Tensor
    role: Tensor
    values: Tensor
    kin: Tensor
    bodies: list[tuple[slice, int, list[Tensor], Tensor]]


@dataclass
class NetworkOutput:
    """first, final (N, K): logits, very negative where there is no bone; doubt (N,): logit of the expected share of
    weight on wrong bones."""

    first: Tensor
    final: Tensor
    doubt: Tensor


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.widen, self.narrow = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, x: Tensor, bias: Tensor) -> Tensor:
        count, tokens, width = x.shape
        qkv = self.qkv(self.norm1(x)).view(count, tokens, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        scores = q @ k.transpose(-1, -2) * (width // self.heads) ** -0.5 + bias
        mixed = (scores.softmax(-1) @ v).transpose(1, 2).reshape(count, tokens, width)
        x = x + self.out(mixed)
        inner = functional.dropout(functional.relu(self.widen(self.norm2(x))), 0.1, self.training)
        out: Tensor = x + self.narrow(inner)
        return out


class PriorNetwork(nn.Module):
    """Scores the bones near each splat."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, shape: Shape | None = None) -> None:
        super().__init__()
        self.shape = s = shape or Shape()
        self.register_buffer("mean", torch.zeros(s.features))
        self.register_buffer("deviation", torch.ones(s.features))
        self.enter = nn.Sequential(nn.Linear(s.features, s.width), nn.ReLU(), nn.Linear(s.width, s.width))
        self.role = nn.Embedding(s.roles, s.width)
        layers = s.before + s.after
        self.layers = nn.ModuleList(_Layer(s.width, s.heads) for _ in range(layers))
        self.kin = nn.Embedding(len(RELATIONS), s.heads * layers)
        self.first = nn.Linear(s.width, 1)
        self.final = nn.Linear(s.width, 1)
        self.norm = nn.LayerNorm(s.width)
        self.last_norm = nn.LayerNorm(s.width)
        self.say = nn.Linear(s.width, s.channels)
        self.hear = nn.Linear(POOLS * (1 + s.channels) + 1, s.width)
        self.doubt = nn.Sequential(nn.Linear(s.width + 3, DOUBT), nn.ReLU(), nn.Linear(DOUBT, 1))
        self.style = nn.Linear(2 * s.width, s.style)
        self.restyle = nn.Linear(s.style, s.width)
        last = nn.Linear(DOUBT, 1)
        self.sharp = nn.Sequential(nn.Linear(s.width + s.style, DOUBT), nn.ReLU(), last)
        self.trust = nn.Parameter(torch.ones(1))  # of the heat weights, where the logits start
        for part in (self.first, self.final, self.kin, self.role, self.restyle, last):
            nn.init.zeros_(part.weight)
        for part in (self.restyle, last):
            nn.init.zeros_(part.bias)

    def forward(self, batch: BodyBatch) -> NetworkOutput:
        missing = batch.bone < 0
        x = self.enter((batch.values - self.mean) / self.deviation) + self.role(batch.role)
        bias = self.kin(batch.kin).permute(3, 0, 1, 2) + missing[None, :, None, :] * FAR
        biases = bias.view(len(self.layers), self.shape.heads, *batch.kin.shape).transpose(1, 2)
        for layer, b in zip(self.layers[: self.shape.before], biases, strict=False):
            x = layer(x, b)
        heat = self.trust * batch.values[..., PRIOR] + missing * FAR
        seen = self.norm(x)
        first = heat + self.first(seen)[..., 0]
        x = x + self._exchange(seen, first, batch)
        style = self._style(seen, first, batch)
        x = x + self.restyle(style)[:, None]
        for layer, b in zip(self.layers[self.shape.before :], biases[self.shape.before :], strict=True):
            x = layer(x, b)
        seen = self.last_norm(x)
        final = first + self.final(seen)[..., 0]
        mixed = (final.softmax(-1)[..., None] * seen).sum(1)
        final = final * torch.exp(SHARPEST * torch.tanh(self.sharp(torch.cat([mixed, style], -1))))
        final = final.clamp(min=FAR)
        return NetworkOutput(first, final, self._doubt(seen.detach(), final.detach()))

    def _exchange(self, seen: Tensor, logits: Tensor, batch: BodyBatch) -> Tensor:
        """Messages of the neighbouring splats about each token's bone."""
        share = logits.softmax(-1)
        words = torch.cat([torch.ones_like(share)[..., None], torch.tanh(self.say(seen))], -1) * share[..., None]
        interrupts = [
            pool_tokens(words[rows], batch.bone[rows], bones, near, labels)
            for rows, bones, near, labels in batch.bodies
        ]
        pooled = torch.cat(interrupts)  # (N, K, POOLS, 1 + channels)
        loud = torch.log(pooled[..., 0] + 1e-3)
        told = pooled[..., 1:] / (pooled[..., :1] + 1e-3)
        out: Tensor = self.hear(torch.cat([loud, told.flatten(2), torch.log(share + 1e-3)[..., None]], -1))
        return out

    def _style(self, seen: Tensor, logits: Tensor, batch: BodyBatch) -> Tensor:
        """(N, style): the same for all splats of a body."""
        mixed = (logits.softmax(-1)[..., None] * seen).sum(1)
        out = []
        for rows, *_ in batch.bodies:
            part = mixed[rows]
            told = torch.cat([part.mean(0), part.std(0)])[None]
            style = torch.tanh(functional.dropout(self.style(told), 0.2, self.training))
            out.append(style.expand(len(part), -1))
        return torch.cat(out)

    def _doubt(self, seen: Tensor, logits: Tensor) -> Tensor:
        share = logits.softmax(-1)
        top = share.topk(min(2, share.shape[-1]), -1).values
        entropy = -(share * torch.log(share + 1e-6)).sum(-1)
        mixed = (share[..., None] * seen).sum(1)
        out: Tensor = self.doubt(torch.cat([mixed, top[:, :1], top[:, -1:], entropy[:, None]], -1))[:, 0]
        return out


def pool_tokens(words: Tensor, bone: Tensor, bones: int, near: Sequence[Tensor], labels: Tensor) -> Tensor:
    """Means of the splats' messages about a bone, over neighbourhoods and over labels.

    words (n, K, C); bone (n, K), -1 where there is none; near: (n, k) splat indices; labels (n, L).
    Returns (n, K, len(near) + L, C); a splat without a token for a bone counts as zero.
    """
    count, channels = len(words), words.shape[-1]
    present = (bone >= 0)[..., None]
    column = bone.clamp(min=0)
    row = torch.arange(count, device=bone.device)[:, None]
    place = row * bones + column
    dense = words.new_zeros(count * bones, channels).index_add(0, place.flatten(), (words * present).flatten(0, 1))
    table = dense.view(count, bones * channels)
    out = []
    for index in near:
        mean = functional.embedding_bag(index, table, mode="mean")
        out.append(mean.view(count * bones, channels)[place])
    for label in labels.T:
        size = torch.bincount(label).clamp(min=1).to(table.dtype)
        total = table.new_zeros(len(size), table.shape[1]).index_add(0, label, table) / size[:, None]
        out.append(total.view(-1, channels)[label[:, None] * bones + column])
    return torch.stack(out, 2)


def make_batch(bodies: Sequence[dict[str, Any]]) -> BodyBatch:
    """Join descriptions given as arrays: bone, values, relation, role, near, wide, labels."""
    bone, role, values, kin, rest, start = [], [], [], [], [], 0
    for body in bodies:
        b = torch.from_numpy(body["bone"].astype("int64"))
        relation = torch.from_numpy(body["relation"].astype("int64"))
        c = b.clamp(min=0)
        kin.append(relation[c[:, :, None], c[:, None, :]])
        bone.append(b)
        role.append(torch.from_numpy(body["role"].astype("int64"))[c])
        values.append(torch.from_numpy(body["values"].astype("float32")))
        near = [torch.from_numpy(body[key].astype("int64")) for key in ("near", "wide")]
        labels = torch.from_numpy(body["labels"].astype("int64"))
        rest.append((slice(start, start + len(b)), len(relation), near, labels))
        start += len(b)
    return BodyBatch(torch.cat(bone), torch.cat(role), torch.cat(values), torch.cat(kin), rest)
