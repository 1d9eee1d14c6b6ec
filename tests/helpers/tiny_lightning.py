# SPDX-License-Identifier: GPL-3.0-or-later
"""Models in LightningDrag's layout with random weights: as many tensors as the published ones, a few channels each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

CONTEXT, WIDTHS, POINT_WIDTH, CLIP_WIDTH = 16, (8, 16, 32, 32), 2, 12


def tiny_unet(channels: int, layers: int = 2, widths: tuple[int, ...] = WIDTHS) -> Any:
    """A UNet with the blocks of Stable Diffusion 1.5: with two layers a block, 32 attentions and 686 tensors."""
    from diffusers import UNet2DConditionModel

    return UNet2DConditionModel(
        sample_size=8,
        in_channels=channels,
        layers_per_block=layers,
        block_out_channels=widths,
        cross_attention_dim=CONTEXT,
        attention_head_dim=2,
        norm_num_groups=4,
    )


def write_models(root: Path, seed: int = 0, unet: Any = None, vae: Any = None) -> Path:
    """One folder per role in `root`, which is returned; `unet` and `vae` where given, else random ones."""
    from diffusers import AutoencoderKL, DDIMScheduler
    from safetensors.torch import save_file
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModelWithProjection

    torch.manual_seed(seed)
    base = root / "base"
    unet = unet or tiny_unet(9)
    unet.save_pretrained(base / "unet")
    write_tokenizer(base / "tokenizer")
    text = CLIPTextConfig(
        vocab_size=8,
        hidden_size=CONTEXT,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        bos_token_id=6,
        eos_token_id=7,
        pad_token_id=7,
    )
    CLIPTextModel(text).save_pretrained(base / "text_encoder")
    DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", steps_offset=1, clip_sample=False
    ).save_pretrained(base / "scheduler")
    vae = vae or AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(8, 8, 8, 8),
        norm_num_groups=4,
        latent_channels=4,
        layers_per_block=1,
    )
    vae.save_pretrained(root / "vae")
    vision = CLIPVisionConfig(
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        image_size=28,
        patch_size=14,
        projection_dim=CLIP_WIDTH,
    )
    models = root / "ip_adapter/models"
    CLIPVisionModelWithProjection(vision).save_pretrained(models / "image_encoder")
    write_checkpoint(root / "lightning_drag", unet, models / "ip-adapter_sd15.bin")
    (root / "lcm_lora").mkdir()
    save_file(kohya_lora(unet), root / "lcm_lora/pytorch_lora_weights.safetensors")
    return root


def write_checkpoint(folder: Path, unet: Any, ip_adapter: Path) -> None:
    """A LightningDrag checkpoint that fits `unet`, and an IP-Adapter."""
    from safetensors.torch import save_file

    from gskin_addon.core.guidance.lightning_drag.appearance import absent_keys
    from gskin_addon.core.guidance.lightning_drag.image_tokens import ImageTokens
    from gskin_addon.core.guidance.lightning_drag.point_embedding import PointEmbedding
    from gskin_addon.core.guidance.lightning_drag.processors import install

    points = PointEmbedding(POINT_WIDTH)
    (folder / "point_embedding").mkdir(parents=True)
    torch.save(points.state_dict(), folder / "point_embedding/point_embedding.pt")
    processors = install(unet, points.embeddings)
    for processor in processors[::2]:  # a trained model's points have an effect, and no bias of it is zero
        torch.nn.init.normal_(processor.norm.bias)
        torch.nn.init.normal_(processor.proj.weight)
    torch.save(processors.state_dict(), folder / "lightning-drag-sd15-attn.bin")
    shape = (unet.config.layers_per_block, unet.config.block_out_channels)
    encoder = tiny_unet(4, *shape)
    absent = absent_keys(encoder)
    (folder / "appearance_encoder").mkdir()
    kept = {key: value.contiguous() for key, value in encoder.state_dict().items() if key not in absent}
    save_file(kept, folder / "appearance_encoder/diffusion_pytorch_model.safetensors")
    config = {**encoder.config, "_class_name": "AppearanceEncoderModel"}
    (folder / "appearance_encoder/config.json").write_text(json.dumps(config, default=list))
    adapters = install(tiny_unet(9, *shape), points.embeddings).state_dict()
    cross = {key: value for key, value in adapters.items() if "_ip." in key}
    torch.save({"image_proj": ImageTokens(CLIP_WIDTH, CONTEXT).state_dict(), "ip_adapter": cross}, ip_adapter)


def write_tokenizer(folder: Path) -> None:
    """A tokenizer that knows the letter a."""
    folder.mkdir(parents=True)
    words = ["a", "a</w>", "b", "b</w>", "c", "c</w>", "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    special = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "unk_token": "<|endoftext|>"}
    config = {"tokenizer_class": "CLIPTokenizer", "pad_token": "<|endoftext|>", "model_max_length": 77, **special}
    (folder / "tokenizer_config.json").write_text(json.dumps(config))


def kohya_lora(unet: Any, rank: int = 2, seed: int = 5) -> dict[str, torch.Tensor]:
    """A LoRA of some layers of `unet`, named as LCM-LoRA's file names them."""
    stream = torch.Generator().manual_seed(seed)
    places = [
        "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q",
        "mid_block.attentions.0.proj_in",
        "up_blocks.3.resnets.0.conv1",
        "up_blocks.3.resnets.0.conv_shortcut",
        "down_blocks.1.attentions.0.transformer_blocks.0.attn2.to_out.0",
        "down_blocks.0.resnets.0.time_emb_proj",
        "up_blocks.1.attentions.0.transformer_blocks.0.ff.net.0.proj",
    ]
    state: dict[str, torch.Tensor] = {}
    for place in places:
        shape = unet.get_submodule(place).weight.shape
        stem = "lora_unet_" + place.replace(".", "_")
        rest = (1, 1) if len(shape) == 4 else ()
        state[f"{stem}.lora_down.weight"] = torch.randn((rank, *shape[1:]), generator=stream) * 0.3
        state[f"{stem}.lora_up.weight"] = torch.randn((shape[0], rank, *rest), generator=stream) * 0.3
        state[f"{stem}.alpha"] = torch.tensor(1.0)
    return state
