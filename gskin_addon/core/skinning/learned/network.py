# SPDX-License-Identifier: GPL-3.0-or-later
"""The network: a splat's nearest bones look at each other, then at what neighbouring splats chose.

Per splat a set of K bone tokens; attention among them with a bias for their kinship; a first softmax over the
bones; its choice averaged over the splat's neighbourhoods and parts, and what all splats of the body have in common;
attention once more; the final softmax, sharper or softer as the body asks for.

Inference only, in numpy alone; what is trained is core/training/prior/torch_network.py, with the same parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.bone_roles import ROLES
from ...ticks import Tick, cores, silent, stretch, work
from .features import NAMES, PRIOR, Description
from .parts import Parts, label_means
from .tree import RELATIONS

Array = NDArray[Any]

POOLS = 5
DOUBT = 32
"""Width of the layers inside `doubt` and `sharp`."""

FAR = -1e4
"""The logit of no bone."""

SHARPEST = 1.5
"""Logarithm of the most that the logits may grow or shrink by."""

_BLOCK = 400  # splats at a time: small enough for the processor's cache
_THREADS = 2
_EPSILON = np.float32(1e-5)  # torch's, in its norms


@dataclass(frozen=True)
class Shape:
    """Sizes of the network; `before` and `after` count the layers on either side of the exchange; `style`: numbers
    that describe how a body as a whole is weighted, such as rigid or soft."""

    features: int = len(NAMES)
    width: int = 48
    heads: int = 4
    before: int = 2
    after: int = 1
    channels: int = 4
    style: int = 16
    roles: int = len(ROLES)

    def as_dict(self) -> dict[str, int]:
        """Plain numbers, for a file's metadata."""
        return asdict(self)


@dataclass
class Answer:
    """first, final (N, K): logits, very negative where there is no bone; doubt (N,): logit of the expected share of
    weight on wrong bones."""

    first: Array
    final: Array
    doubt: Array


def parameter_shapes(shape: Shape) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all that is learned, in the order of torch's modules."""
    s, layers = shape, shape.before + shape.after
    out: dict[str, tuple[int, ...]] = {"trust": (1,), "mean": (s.features,), "deviation": (s.features,)}

    def linear(name: str, inputs: int, outputs: int) -> None:
        out[f"{name}.weight"], out[f"{name}.bias"] = (outputs, inputs), (outputs,)

    def norm(name: str) -> None:
        out[f"{name}.weight"] = out[f"{name}.bias"] = (s.width,)

    linear("enter.0", s.features, s.width)
    linear("enter.2", s.width, s.width)
    out["role.weight"] = (s.roles, s.width)
    for number in range(layers):
        norm(f"layers.{number}.norm1")
        norm(f"layers.{number}.norm2")
        linear(f"layers.{number}.qkv", s.width, 3 * s.width)
        linear(f"layers.{number}.out", s.width, s.width)
        linear(f"layers.{number}.widen", s.width, 2 * s.width)
        linear(f"layers.{number}.narrow", 2 * s.width, s.width)
    out["kin.weight"] = (len(RELATIONS), s.heads * layers)
    linear("first", s.width, 1)
    linear("final", s.width, 1)
    norm("norm")
    norm("last_norm")
    linear("say", s.width, s.channels)
    linear("hear", POOLS * (1 + s.channels) + 1, s.width)
    linear("doubt.0", s.width + 3, DOUBT)
    linear("doubt.2", DOUBT, 1)
    linear("style", 2 * s.width, s.style)
    linear("restyle", s.style, s.width)
    linear("sharp.0", s.width + s.style, DOUBT)
    linear("sharp.2", DOUBT, 1)
    return out


class PriorNetwork:
    """Scores the bones near each splat."""

    def __init__(self, shape: Shape, parameters: Mapping[str, Array]) -> None:
        """parameters: by the names of `parameter_shapes`.

        Raises:
            ValueError: one is missing, or has another shape.
        """
        for name, wanted in parameter_shapes(shape).items():
            if name not in parameters or parameters[name].shape != wanted:
                raise ValueError(f"'{name}' is missing or not of shape {wanted}")
        self.shape = shape
        self.parameters = {
            name: np.ascontiguousarray(parameters[name], np.float32) for name in parameter_shapes(shape)
        }

    def __call__(self, described: Description, parts: Parts, tick: Tick = silent) -> Answer:
        """The answer for the N splats of one body, all of them described."""
        return _Pass(self, described, parts).run(tick)

    def linear(self, name: str, x: Array) -> Array:
        """A matrix and an offset on the last axis of x."""
        weight, bias = self.parameters[f"{name}.weight"], self.parameters[f"{name}.bias"]
        out = x.reshape(-1, x.shape[-1]) @ weight.T
        out += bias
        return out.reshape(*x.shape[:-1], len(bias))

    def norm(self, name: str, x: Array) -> Array:
        """The last axis of x with mean 0 and variance 1, then scaled and moved."""
        out = x - (_sum(x) / np.float32(x.shape[-1]))[..., None]
        variance = np.einsum("...k,...k->...", out, out) / np.float32(x.shape[-1])
        out *= (1 / np.sqrt(variance + _EPSILON))[..., None]
        out *= self.parameters[f"{name}.weight"]
        out += self.parameters[f"{name}.bias"]
        return out

    def pair(self, name: str, x: Array) -> Array:
        """Two linear layers with a ReLU between."""
        inner = self.linear(f"{name}.0", x)
        return self.linear(f"{name}.2", np.maximum(inner, 0, out=inner))


class _Pass:
    """One body on its way through the network, some splats at a time."""

    def __init__(self, network: PriorNetwork, described: Description, parts: Parts) -> None:
        self.network, self.described, self.parts = network, described, parts
        count, tokens = described.bone.shape
        width = network.shape.width
        self.column = np.maximum(described.bone, 0).astype(np.int64)
        self.missing = described.bone < 0
        self.hidden = np.empty((count, tokens, width), np.float32)
        self.first, self.final = (np.empty((count, tokens), np.float32) for _ in range(2))
        self.words = np.empty((count, tokens, 1 + network.shape.channels), np.float32)
        self.mixed = np.empty((count, width), np.float32)
        self.doubt = np.empty(count, np.float32)

    def run(self, tick: Tick) -> Answer:
        """Both halves, and the exchange between them."""
        self._each(self._before, stretch(tick, 0.0, 0.55))
        bones = len(self.described.relation)
        near = self.parts.near
        pooled = pool_tokens(self.words, self.column, self.missing, bones, near, self.parts.labels)
        told = np.concatenate([self.mixed.mean(axis=0), self.mixed.std(axis=0, ddof=1)])
        style = np.tanh(self.network.linear("style", told[None]))[0]
        self._each(partial(self._after, pooled, style), stretch(tick, 0.6, 1.0))
        return Answer(self.first, self.final, self.doubt)

    def _each(self, step: Callable[[slice], None], tick: Tick) -> None:
        """A step for all blocks, in threads."""
        count, threads = len(self.hidden), min(_THREADS, cores())
        cuts = np.linspace(0, -(-count // _BLOCK), threads + 1).astype(int) * _BLOCK

        def some(first: int, last: int, tick: Tick) -> None:
            for begin in range(first, last, _BLOCK):
                step(slice(begin, min(begin + _BLOCK, count)))
                tick((begin + _BLOCK - first) / (last - first))

        pairs = zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)
        work([partial(some, a, b) for a, b in pairs if b > a], tick, threads)

    def _before(self, rows: slice) -> None:
        net, values = self.network, np.asarray(self.described.values[rows], np.float32)
        own = net.parameters
        role = np.asarray(self.described.role, np.int64)[self.column[rows]]
        x = net.pair("enter", (values - own["mean"]) / own["deviation"]) + own["role.weight"][role]
        for number in range(net.shape.before):
            x = self._layer(number, x, rows)
        seen = net.norm("norm", x)
        logits = own["trust"] * values[..., PRIOR] + net.linear("first", seen)[..., 0]
        logits += self.missing[rows] * np.float32(FAR)
        share = softmax(logits)
        self.hidden[rows], self.first[rows] = x, logits
        self.words[rows, :, 0] = share
        self.words[rows, :, 1:] = np.tanh(net.linear("say", seen)) * share[..., None]
        self.mixed[rows] = _mix(share, seen)

    def _after(self, pooled: Array, style: Array, rows: slice) -> None:
        net, first = self.network, self.first[rows]
        heard = pooled[rows]
        small = np.float32(1e-3)
        loud = np.log(heard[..., 0] + small)
        told = heard[..., 1:] / (heard[..., :1] + small)
        told = told.reshape(*told.shape[:2], -1)
        share = softmax(first)
        x = self.hidden[rows] + net.linear("hear", np.concatenate([loud, told, np.log(share + small)[..., None]], -1))
        x += net.linear("restyle", style[None])[0]
        for number in range(net.shape.before, net.shape.before + net.shape.after):
            x = self._layer(number, x, rows)
        seen = net.norm("last_norm", x)
        final = first + net.linear("final", seen)[..., 0]
        mixed = _mix(softmax(final), seen)
        sharp = net.pair("sharp", np.concatenate([mixed, np.broadcast_to(style, (len(mixed), len(style)))], axis=-1))
        final = np.maximum(final * np.exp(np.float32(SHARPEST) * np.tanh(sharp)), np.float32(FAR))
        self.final[rows] = final
        share = softmax(final)
        ranked = np.sort(share, axis=-1)
        entropy = -(share * np.log(share + np.float32(1e-6))).sum(axis=-1)
        second = ranked[:, -min(2, ranked.shape[1])]
        looks = np.concatenate([_mix(share, seen), np.stack([ranked[:, -1], second, entropy], axis=-1)], axis=-1)
        self.doubt[rows] = net.pair("doubt", looks)[:, 0]

    def _layer(self, number: int, x: Array, rows: slice) -> Array:
        """Attention among the tokens (n, K, width) of each splat, then two linear layers."""
        net, name = self.network, f"layers.{number}"
        count, tokens, width = x.shape
        heads = net.shape.heads
        qkv = net.linear(f"{name}.qkv", net.norm(f"{name}.norm1", x)).reshape(count, tokens, 3, heads, width // heads)
        q, k, v = np.ascontiguousarray(qkv.transpose(2, 0, 3, 1, 4))
        scores = q @ np.ascontiguousarray(k.transpose(0, 1, 3, 2))
        scores *= np.float32((width // heads) ** -0.5)
        column = self.column[rows]
        kin = np.asarray(self.described.relation, np.int64)[column[:, :, None], column[:, None, :]]
        weight = net.parameters["kin.weight"]
        for head in range(heads):
            scores[:, head] += np.take(weight[:, number * heads + head], kin)
        scores += (self.missing[rows] * np.float32(FAR))[:, None, None, :]
        mixed = (softmax(scores) @ v).transpose(0, 2, 1, 3).reshape(count, tokens, width)
        x = x + net.linear(f"{name}.out", mixed)
        inner = net.linear(f"{name}.widen", net.norm(f"{name}.norm2", x))
        x += net.linear(f"{name}.narrow", np.maximum(inner, 0, out=inner))
        return x


def softmax(x: Array) -> Array:
    """Shares along the last axis, which is short; float32."""
    most = x[..., 0].copy()
    for k in range(1, x.shape[-1]):
        np.maximum(most, x[..., k], out=most)
    out = x - most[..., None]
    np.exp(out, out=out)
    out *= (1 / _sum(out))[..., None]
    return out


def _sum(x: Array) -> Array:
    """Along the last axis; a product with ones, since numpy's own sum is slow along a short axis."""
    return np.asarray(x @ np.ones(x.shape[-1], np.float32))


def _mix(share: Array, seen: Array) -> Array:
    """(n, width): the tokens seen (n, K, width) by their shares (n, K)."""
    return (share[:, None, :] @ seen)[:, 0]


def pool_tokens(
    words: Array, column: Array, missing: Array, bones: int, near: tuple[Array, ...], labels: Array
) -> Array:
    """Means of what splats say of a bone, over neighbourhoods and over labels.

    words (n, K, C); column (n, K): bones, any where missing (n, K); near: (n, k) splat indices; labels (n, L).
    Returns (n, K, len(near) + L, C); a splat without a token for a bone says zero about it.
    """
    count, tokens, channels = words.shape
    table = np.zeros((count * bones, channels), np.float32)
    place = np.arange(count)[:, None] * bones + column
    table[place[~missing]] = words[~missing]
    out = np.zeros((count, tokens, len(near) + labels.shape[1], channels), np.float32)
    for number, index in enumerate(near):
        index = index.astype(np.int64)
        for neighbour in index.T:
            out[:, :, number] += np.take(table, neighbour[:, None] * bones + column, axis=0)
        out[:, :, number] /= np.float32(index.shape[1])
    for number, label in enumerate(labels.T.astype(np.int64), len(near)):
        mean = label_means(table.reshape(count, -1), label).reshape(-1, channels)
        out[:, :, number] = np.take(mean, label[:, None] * bones + column, axis=0)
    return out
