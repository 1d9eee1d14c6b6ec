# SPDX-License-Identifier: GPL-3.0-or-later
"""Which files of which models LightningDrag needs, and where the person has them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from ..model_files import ModelFiles, find_model, stamp
from ..options import LightningDragOptions

APPEARANCE = "appearance_encoder"
POINTS = "point_embedding/point_embedding.pt"
ATTENTION = "lightning-drag-sd15-attn.bin"
FINE_TUNED = "fine_tuned.json"
"""Beside a checkpoint of `gskin train-guidance`: how it was made."""

_DIFFUSERS = ("diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.fp16.safetensors")
_DIFFUSERS_ANY = (*_DIFFUSERS, "diffusion_pytorch_model.bin")
_TRANSFORMERS_ANY = ("model.safetensors", "model.fp16.safetensors", "pytorch_model.bin")


def _within(folder: str, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{folder}/{name}" for name in names)


ROLES: dict[str, ModelFiles] = {
    "base": ModelFiles(
        "base inpainting model",
        (
            "unet/config.json",
            _within("unet", _DIFFUSERS_ANY),
            "text_encoder/config.json",
            _within("text_encoder", _TRANSFORMERS_ANY),
            "tokenizer/vocab.json",
            "tokenizer/merges.txt",
            "scheduler/scheduler_config.json",
        ),
        "OpenRAIL-M",
        "Lykon/dreamshaper-8-inpainting",
        (
            "unet/config.json",
            "unet/diffusion_pytorch_model.safetensors",
            "text_encoder/config.json",
            "text_encoder/model.safetensors",
            "tokenizer/*",
            "scheduler/scheduler_config.json",
        ),
    ),
    "vae": ModelFiles(
        "VAE",
        ("config.json", _DIFFUSERS_ANY),
        "MIT",
        "stabilityai/sd-vae-ft-mse",
        ("config.json", "diffusion_pytorch_model.safetensors"),
    ),
    "ip_adapter": ModelFiles(
        "IP-Adapter",
        (
            "models/image_encoder/config.json",
            _within("models/image_encoder", _TRANSFORMERS_ANY),
            ("models/ip-adapter_sd15.bin", "models/ip-adapter_sd15.safetensors"),
        ),
        "Apache-2.0",
        "h94/IP-Adapter",
        (
            "models/image_encoder/config.json",
            "models/image_encoder/model.safetensors",
            "models/ip-adapter_sd15.bin",
        ),
    ),
    "lightning_drag": ModelFiles(
        "LightningDrag checkpoint",
        (
            _within(APPEARANCE, ("diffusion_pytorch_model.safetensors",)),
            POINTS,
            ATTENTION,
        ),
        "none is stated for these weights",
        "LightningDrag/lightning-drag-sd15",
    ),
    "lcm_lora": ModelFiles(
        "LCM-LoRA",
        ("pytorch_lora_weights.safetensors",),
        "openrail++",
        "latent-consistency/lcm-lora-sdv1-5",
    ),
}


@dataclass(frozen=True)
class Files:
    """Folders of the five roles; `lcm_lora` is None where the scheduler does without."""

    base: Path
    vae: Path
    ip_adapter: Path
    lightning_drag: Path
    lcm_lora: Path | None = None

    def stamps(self) -> dict[str, Any]:
        """What tells whether any of the files was exchanged."""
        roles = {role: getattr(self, role) for role in ROLES}
        return {
            role: stamp(folder, [*_all_patterns(ROLES[role]), FINE_TUNED])
            for role, folder in roles.items()
            if folder is not None
        }

    def fine_tuned(self) -> dict[str, Any]:
        """What `fine_tuned.json` says; empty for a checkpoint as published."""
        path = self.lightning_drag / FINE_TUNED
        table = read_table(path) if path.is_file() else {}
        most = table.get("max_points", 0)
        if type(most) is not int or most < 0:
            raise InputError(
                f"'{path}' says max_points {most!r}, which is no number of control points; write a whole number from 0 "
                "up, or get the file again."
            )
        return table


def _all_patterns(files: ModelFiles) -> list[str]:
    return [name for need in files.needs for name in ((need,) if isinstance(need, str) else need)]


def find_files(
    options: LightningDragOptions,
    tell: Callable[[str], None] = lambda message: None,
    *,
    allow_download: bool = False,
) -> Files:
    """The folders that `options` name, all complete; the base model has a UNet for inpainting.

    allow_download: the person agreed to fetch what is missing; `tell` hears of it first.

    Raises:
        InputError: something is not named, not there, or not what it should be.
    """
    roles = [role for role in ROLES if role != "lcm_lora" or options.scheduler == "lcm"]
    found = {}
    for role in roles:
        name = getattr(options, role) or (str(Path(options.models).expanduser() / role) if options.models else "")
        found[role] = find_model(name, ROLES[role], allow_download=allow_download, tell=tell)
    files = Files(**found)
    check_base(read_table(files.base / "unet/config.json"), files.base)
    return files


def check_base(config: Mapping[str, Any], folder: Path) -> None:
    """Raise InputError unless this is the configuration of an inpainting UNet of the family of SD 1.5."""
    channels = config.get("in_channels", 4)
    if channels == 4:
        raise InputError(
            f"The base model in '{folder}' is no inpainting model: its UNet takes 4 channels, not 9; choose an "
            f"inpainting one such as '{ROLES['base'].hub_id}'."
        )
    if channels != 9 or config.get("use_linear_projection") or config.get("addition_embed_type"):
        raise InputError(
            f"The base model in '{folder}' is not of the family of Stable Diffusion 1.5 (inpainting); choose one "
            f"such as '{ROLES['base'].hub_id}'."
        )


def read_table(path: Path) -> dict[str, Any]:
    """The table of a .json file. Raises InputError where it holds none."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' cannot be read as JSON ({error}); get the file again.") from None
    if not isinstance(table, dict):
        raise InputError(f"'{path}' does not hold a table of names and values; get the file again.")
    return table
