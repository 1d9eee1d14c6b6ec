# SPDX-License-Identifier: GPL-3.0-or-later
"""A FLUX.2 [klein] pipeline of the real classes with a few thousand random weights, as a folder."""

from __future__ import annotations

from pathlib import Path

import torch
from diffusers import (
    AutoencoderKLFlux2,
    FlowMatchEulerDiscreteScheduler,
    Flux2KleinPipeline,
    Flux2Transformer2DModel,
)
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import Qwen2TokenizerFast, Qwen3Config, Qwen3ForCausalLM

LAYERS = 28
"""The pipeline reads the text encoder's hidden states 9, 18 and 27."""


def save_tiny_flux(folder: Path, *, is_distilled: bool = True, seed: int = 0, halvings: int = 1) -> Path:
    """The VAE halves an image so many times and the packing once more: tokens of 4 pixels, of 16 as in truth with 3."""
    torch.manual_seed(seed)
    hidden = 16
    text_encoder = Qwen3ForCausalLM(
        Qwen3Config(
            vocab_size=64,
            hidden_size=hidden,
            intermediate_size=16,
            num_hidden_layers=LAYERS,
            num_attention_heads=2,
            num_key_value_heads=1,
            head_dim=8,
            max_position_embeddings=512,
        )
    )
    transformer = Flux2Transformer2DModel(
        in_channels=16,
        num_layers=1,
        num_single_layers=1,
        attention_head_dim=16,
        num_attention_heads=2,
        joint_attention_dim=3 * hidden,
        timestep_guidance_channels=16,
        axes_dims_rope=(4, 4, 4, 4),
        guidance_embeds=False,
    )
    vae = AutoencoderKLFlux2(
        down_block_types=("DownEncoderBlock2D",) * (halvings + 1),
        up_block_types=("UpDecoderBlock2D",) * (halvings + 1),
        block_out_channels=(8,) * (halvings + 1),
        layers_per_block=1,
        latent_channels=4,
        norm_num_groups=4,
        mid_block_add_attention=False,
    )
    pipeline = Flux2KleinPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=vae,
        text_encoder=text_encoder,
        tokenizer=_tokenizer(),
        transformer=transformer,
        is_distilled=is_distilled,
    )
    pipeline.save_pretrained(folder, safe_serialization=True)
    return folder


def _tokenizer() -> Qwen2TokenizerFast:
    letters = {chr(97 + i): i for i in range(26)}
    words = Tokenizer(models.BPE(vocab={**letters, "<unk>": 26, "<pad>": 27}, merges=[], unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    return Qwen2TokenizerFast(
        tokenizer_object=words,
        unk_token="<unk>",
        pad_token="<pad>",
        eos_token="<pad>",
        chat_template="{% for message in messages %}{{ message['content'] }}{% endfor %}",
    )
