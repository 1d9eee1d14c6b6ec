# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

diffusers = pytest.importorskip("diffusers")

from gskin_addon.core.guidance.lightning_drag.appearance import absent_keys, appearance_bank, prune  # noqa: E402
from gskin_addon.core.guidance.lightning_drag.point_embedding import PointEmbedding  # noqa: E402
from gskin_addon.core.guidance.lightning_drag.processors import (  # noqa: E402
    Guide,
    ImageCrossAttention,
    PointSelfAttention,
    install,
    self_attentions,
)
from tests.helpers.tiny_lightning import CONTEXT, POINT_WIDTH, tiny_unet  # noqa: E402

# specs of the published model: number of the self-attention -> (hidden, E)
PUBLISHED = {
    **dict.fromkeys((0, 2, 24, 26, 28), (320, 128)),
    **dict.fromkeys((4, 6, 18, 20, 22), (640, 256)),
    **dict.fromkeys((8, 10, 12, 14, 16), (1280, 512)),
    30: (1280, 1024),
}


def stable_diffusion(channels):
    with torch.device("meta"):
        return diffusers.UNet2DConditionModel(
            sample_size=64, in_channels=channels, cross_attention_dim=768, attention_head_dim=8
        )


def test_the_published_attention_weights_have_80_tensors_of_these_shapes():
    with torch.device("meta"):
        state = install(stable_diffusion(9), PointEmbedding().embeddings).state_dict()
    expected = {}
    for number in range(0, 32, 2):
        hidden, width = PUBLISHED[number]
        expected[f"{number}.norm.weight"] = expected[f"{number}.norm.bias"] = (width,)
        expected[f"{number}.proj.weight"] = (hidden, width)
        expected[f"{number + 1}.to_k_ip.weight"] = expected[f"{number + 1}.to_v_ip.weight"] = (hidden, 768)
    assert {key: tuple(tensor.shape) for key, tensor in state.items()} == expected
    assert len(state) == 80


def test_the_published_point_embedding_has_13_tensors_of_these_shapes():
    with torch.device("meta"):
        state = PointEmbedding().state_dict()
    expected = {"conv_in.weight": (32, 2, 3, 3)}
    for group, widths in (("vae", (32, 64, 128, 256)), ("unet", (256, 512, 1024, 2048))):
        for number in range(3):
            inner, outer = widths[number : number + 2]
            stem = f"downsample_blocks_{group}.{number}"
            expected[f"{stem}.conv1.weight"] = (outer, inner, 3, 3)
            expected[f"{stem}.conv2.weight"] = (outer, outer, 3, 3)
    assert {key: tuple(tensor.shape) for key, tensor in state.items()} == expected
    assert len(state) == 13
    assert sum(tensor.numel() for tensor in state.values()) == 75_479_616


def test_points_are_embedded_at_four_resolutions_first_half_for_handles():
    torch.manual_seed(0)
    points = PointEmbedding(POINT_WIDTH)
    maps = torch.rand(2, 2, 64, 128)
    handles, targets = points(maps)
    shapes = [(2, 128 >> 2 * level, 8 << level) for level in range(4)]
    assert [tuple(x.shape) for x in handles] == [tuple(x.shape) for x in targets] == shapes
    x = points.conv_in(maps)  # no activation here
    for block in points.downsample_blocks_vae:
        x = nn.functional.silu(block.conv2(nn.functional.silu(block.conv1(x))))
    torch.testing.assert_close(handles[0], x[:, :8].flatten(2).transpose(1, 2))
    torch.testing.assert_close(targets[0], x[:, 8:].flatten(2).transpose(1, 2))


def slow_attention(x, reference, target, handle, wq, wk, wv, heads):
    """The specification, one number after the other, float64: (T, hidden) before the output projection."""
    query = x @ wq.T + target
    both = np.concatenate([x, reference])
    key = both @ wk.T + np.concatenate([target, handle])
    value = both @ wv.T
    out = np.zeros_like(query)
    size = query.shape[1] // heads
    for head in range(heads):
        part = slice(head * size, (head + 1) * size)
        for row in range(len(query)):
            scores = np.array([query[row, part] @ key[other, part] for other in range(len(both))]) / np.sqrt(size)
            chances = np.exp(scores - scores.max())
            out[row, part] = (chances / chances.sum()) @ value[:, part]
    return out


def fake_attention(hidden, context, heads):
    rng = torch.Generator().manual_seed(3)
    attn = SimpleNamespace(heads=heads, to_out=[nn.Linear(hidden, hidden), nn.Dropout(0.0)])
    for name, width in (("to_q", hidden), ("to_k", context), ("to_v", context)):
        layer = nn.Linear(width, hidden, bias=False)
        layer.weight.data.normal_(generator=rng)
        setattr(attn, name, layer)
    return attn


@torch.no_grad()
def test_self_attention_is_the_formula():
    torch.manual_seed(1)
    hidden, width, tokens = 8, 6, 5
    attn, processor = fake_attention(hidden, hidden, 2), PointSelfAttention(hidden, width, 1, 0)
    processor.norm.weight.normal_()
    processor.norm.bias.normal_()
    x, bank = torch.randn(2, tokens, hidden), [None, torch.randn(1, tokens, hidden)]
    handles, targets = torch.randn(2, tokens, width), torch.randn(2, tokens, width)
    shown = torch.tensor([0.0, 1.0])[:, None, None]
    out = processor(attn, x, guide=Guide(bank, torch.zeros(1, 4, 1), [handles], [targets], shown))
    wq, wk, wv, wo = (layer.weight.double().numpy() for layer in (attn.to_q, attn.to_k, attn.to_v, attn.to_out[0]))
    for row in range(2):
        moves = []
        for embedding in (targets, handles):
            e = embedding[row].double().numpy()
            e = (e - e.mean(1, keepdims=True)) / np.sqrt(e.var(1, keepdims=True) + 1e-5)
            e = e * processor.norm.weight.double().numpy() + processor.norm.bias.double().numpy()
            moves.append(row * (e @ processor.proj.weight.double().numpy().T))  # row 0 does not see the points
        slow = slow_attention(x[row].double().numpy(), bank[1][0].double().numpy(), *moves, wq, wk, wv, 2)
        slow = slow @ wo.T + attn.to_out[0].bias.double().numpy()
        np.testing.assert_allclose(out[row].numpy(), slow, atol=2e-5)


@torch.no_grad()
def test_cross_attention_adds_the_image_to_the_text():
    torch.manual_seed(2)
    hidden, context, heads = 8, 6, 2
    attn, processor = fake_attention(hidden, context, heads), ImageCrossAttention(hidden, context)
    x, text, tokens = torch.randn(1, 5, hidden), torch.randn(1, 7, context), torch.randn(1, 4, context)
    out = processor(attn, x, text, guide=Guide([], tokens, [], [], torch.zeros(1, 1, 1)))

    def slow(states, wk, wv):
        q = (x[0] @ attn.to_q.weight.T).unflatten(1, (heads, -1))
        k, v = (states[0] @ wk.T).unflatten(1, (heads, -1)), (states[0] @ wv.T).unflatten(1, (heads, -1))
        parts = [torch.softmax(q[:, h] @ k[:, h].T / 2, dim=1) @ v[:, h] for h in range(heads)]
        return torch.cat(parts, dim=1)

    both = slow(text, attn.to_k.weight, attn.to_v.weight)
    both += slow(tokens, processor.to_k_ip.weight, processor.to_v_ip.weight)
    torch.testing.assert_close(out[0], attn.to_out[0](both), atol=1e-5, rtol=1e-5)


def random_guide(unet, encoder, points, maps, shown):
    bank = appearance_bank(encoder, torch.randn(1, 4, 8, 8), torch.randn(1, 77, CONTEXT), self_attentions(unet))
    handles, targets = points(maps)
    return Guide(bank, torch.randn(1, 4, CONTEXT), handles, targets, shown)


@torch.no_grad()
def test_points_have_no_effect_in_the_unconditional_half():
    torch.manual_seed(0)
    unet, encoder, points = tiny_unet(9), tiny_unet(4), PointEmbedding(POINT_WIDTH)
    for processor in install(unet, points.embeddings)[::2]:
        processor.norm.bias.normal_()
    maps = torch.zeros(4, 2, 64, 64)
    maps[0, 0, 3, 5] = maps[0, 1, 40, 50] = maps[2, 0, 60, 2] = maps[2, 1, 8, 8] = 9.0
    guide = random_guide(unet, encoder, points, maps, torch.tensor([0.0, 0.0, 1.0, 1.0])[:, None, None])
    latents = torch.randn(1, 9, 8, 8).expand(4, -1, -1, -1)
    text = torch.randn(1, 77, CONTEXT).expand(4, -1, -1)
    out = unet(latents, 500, text, cross_attention_kwargs={"guide": guide})[0]
    assert torch.equal(out[0], out[1])  # other points, not shown: not one bit
    assert (out[2] - out[3]).abs().max() > 1e-4  # other points, shown
    assert (out[1] - out[3]).abs().max() > 1e-4  # even a map without points says something


def test_exactly_24_tensors_are_absent_from_a_published_appearance_encoder():
    unet = stable_diffusion(4)
    absent, every = absent_keys(unet), set(unet.state_dict())
    stem = "up_blocks.3.attentions.2"
    inner = f"{stem}.transformer_blocks.0"
    attention = [f"{part}.weight" for part in ("to_q", "to_k", "to_v", "to_out.0")] + ["to_out.0.bias"]
    expected = {f"{part}.{kind}" for part in ("conv_norm_out", "conv_out", f"{stem}.proj_out") for kind in KINDS}
    expected |= {f"{inner}.{part}.{key}" for part in ("attn1", "attn2") for key in attention}
    expected |= {f"{inner}.{part}.{kind}" for part in ("norm2", "norm3", "ff.net.0.proj", "ff.net.2") for kind in KINDS}
    assert absent == expected
    assert (len(absent), len(every)) == (24, 686)
    prune(unet)
    assert set(unet.state_dict()) == every - absent


KINDS = ("weight", "bias")


@torch.no_grad()
def test_the_bank_is_what_the_self_attentions_of_the_whole_encoder_are_given():
    torch.manual_seed(0)
    encoder = tiny_unet(4)
    latents, text = torch.randn(1, 4, 8, 8), torch.randn(1, 77, CONTEXT)
    places = self_attentions(encoder)
    given = {}

    def watch(place):
        return lambda module, args: given.setdefault(place, args[0])

    hooks = [encoder.get_submodule(place).register_forward_pre_hook(watch(place)) for place in places]
    encoder(latents, 0, text)
    for hook in hooks:
        hook.remove()
    prune(encoder)
    bank = appearance_bank(encoder, latents, text, places)
    assert len(bank) == 16
    for place, tokens in zip(places, bank, strict=True):
        torch.testing.assert_close(tokens, given[place])
    assert [tuple(x.shape[1:]) for x in bank[:6:2]] == [(64, 8), (16, 16), (4, 32)]
