# SPDX-License-Identifier: GPL-3.0-or-later
"""A set of image pairs and models small enough to fine-tune in a test."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gskin_addon.core.files import write_json
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.mask import dynamic_mask
from gskin_addon.core.guidance.provider import to_bytes
from gskin_addon.core.guidance.skeleton_image import project_bones
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.lbs import skin_cloud
from gskin_addon.core.training.guidance.pairs import MANIFEST, SHARDS, VERSION, encode_image
from tests.helpers.limb import make_limb
from tests.helpers.sampler_reference import SCALING
from tests.helpers.tiny_lightning import tiny_unet, write_models

SIZE = 64


def write_pairs(folder: Path, poses: int = 2, views: int = 2) -> Path:
    """Pairs of a limb, which are both the ones to train on and the ones to validate on."""
    limb = make_limb(600)
    cameras = paper_views(*limb.cloud.bounds(), SIZE)[:views]
    signals = make_signals(limb.skeleton, cameras, poses, np.random.default_rng(1))
    rests = [render_cloud(limb.cloud, camera)[0] for camera in cameras]
    arrays: dict[str, Any] = {f"rest_{view}": encode_image(to_bytes(rest)) for view, rest in enumerate(rests)}
    arrays["view"] = np.array([signal.view for signal in signals])
    for number, signal in enumerate(signals):
        posed = render_cloud(skin_cloud(limb.cloud, limb.weights, signal.transforms), signal.camera)[0]
        arrays[f"posed_{number}"] = encode_image(to_bytes(posed))
        arrays[f"mask_{number}"] = encode_image(dynamic_mask(rests[signal.view], posed))
        arrays[f"handles_{number}"] = signal.handles.astype(np.float32)
        arrays[f"targets_{number}"] = signal.targets.astype(np.float32)
        bones = project_bones(limb.skeleton, signal.transforms, signal.camera)
        arrays[f"bones_{number}"], arrays[f"bone_{number}"] = np.stack([bones.rest, bones.posed]), bones.bone
    (folder / SHARDS).mkdir(parents=True)
    np.savez(folder / SHARDS / "limb.npz", **arrays)
    shards = [
        {"file": "limb.npz", "asset": "limb", "split": split, "pairs": len(signals)}
        for split in ("train", "validation")
    ]
    write_json(
        folder / MANIFEST,
        {"version": VERSION, "settings": {"size": SIZE}, "assets": [], "shards": shards, "failed": {}},
    )
    return folder


@torch.no_grad()
def mean_vae() -> Any:
    """An exact autoencoder with the VAE's parts: latents are the means of 8 x 8 pixels, decoded as squares.

    Residual branches and attention are zero, down- and upsampling average and repeat. The last normalisation is made
    nearly linear by two channels of large constant values that share its only group.
    """
    from diffusers import AutoencoderKL

    width, large = 8, 100.0
    vae = AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(width,) * 4,
        norm_num_groups=1,
        latent_channels=4,
        layers_per_block=1,
        scaling_factor=SCALING,
    )
    for name, value in vae.named_parameters():
        if "norm" not in name:
            value.zero_()

    def same(conv: Any, channels: int, factor: float = 1.0) -> None:
        middle = conv.weight.shape[-1] // 2
        for c in range(channels):
            conv.weight[c, c, middle, middle] = factor

    spread = large * (2 / width) ** 0.5
    for half in (vae.encoder, vae.decoder):
        same(half.conv_in, 3)
        half.conv_in.weight[3:6, :3] = -half.conv_in.weight[:3, :3]  # so that the mean of all channels is 0
        half.conv_in.bias[6], half.conv_in.bias[7] = large, -large
        same(half.conv_out, 3, 2 * spread)  # silu(x) is x / 2 near 0
    for block in vae.encoder.down_blocks[:-1]:
        for c in range(width):
            block.downsamplers[0].conv.weight[c, c, :2, :2] = 0.25
    for block in vae.decoder.up_blocks[:-1]:
        same(block.upsamplers[0].conv, width)
    # Latents of about unit size, whatever Stable Diffusion's factor makes of them.
    same(vae.quant_conv, 4, 2.0 / SCALING)
    same(vae.post_quant_conv, 4, SCALING / 2.0)
    vae.quant_conv.bias[4:] = -30.0  # no noise
    return vae.eval()


@torch.no_grad()
def linear_unet(seed: int = 0) -> Any:
    """A UNet that solves the noise outside the mask exactly, and says "grey" inside, plus random features.

    It is made for `one_noise`, where noisy = sqrt(1/2) (image + noise), so noise = sqrt(2) noisy - image. Its first
    convolution hands noisy - sqrt(1/2) masked to the last block as it is; there each normalisation group holds a
    channel, its negative, and two large constants, which makes the normalisation nearly linear.
    """
    torch.manual_seed(seed)
    width, large, half = 16, 100.0, 0.5**0.5
    unet = tiny_unet(9, 1, (width,) * 4)
    unet.conv_in.weight.zero_()
    unet.conv_in.bias.zero_()
    unet.conv_out.weight.zero_()
    unet.conv_out.bias.zero_()
    last = unet.up_blocks[-1].resnets[-1]
    last.conv2.weight.mul_(0.1)
    last.conv_shortcut.weight.zero_()
    last.conv_shortcut.weight[:, width:, 0, 0] = torch.eye(width)
    for c in range(4):
        for channel, sign in ((4 * c, 1.0), (4 * c + 1, -1.0)):
            unet.conv_in.weight[channel, c, 1, 1] = sign
            unet.conv_in.weight[channel, 5 + c, 1, 1] = -sign * half
            unet.conv_out.weight[c, channel, 1, 1] = sign * large  # sqrt(2) times the inverse of what comes before
        unet.conv_in.bias[4 * c + 2], unet.conv_in.bias[4 * c + 3] = large, -large
    return unet


def write_tiny(root: Path) -> Path:
    """Models that can be fine-tuned in seconds; `root` is returned."""
    write_models(root, unet=linear_unet(), vae=mean_vae())
    config = root / "base/scheduler/scheduler_config.json"
    betas = [1e-4, 0.5] + [1e-6] * 998  # the same noise at all timesteps
    config.write_text(json.dumps({**json.loads(config.read_text()), "trained_betas": betas}))
    return root
