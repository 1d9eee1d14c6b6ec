# SPDX-License-Identifier: GPL-3.0-or-later
"""Merging a LoRA into the weights that it was trained for: W += (alpha / rank) B A. Needs no peft.

Reads both ways of naming that the published files use: `lora_unet_down_blocks_0_..._to_q.lora_down.weight` with
`.alpha` (LCM-LoRA), and `unet.down_blocks.0....to_q.lora_A.weight` (diffusers with peft; alpha is the rank).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ...errors import InputError

_SUFFIXES = {
    ".lora_down.weight": "down",
    ".lora_up.weight": "up",
    ".lora_A.weight": "down",
    ".lora_B.weight": "up",
    ".lora.down.weight": "down",
    ".lora.up.weight": "up",
    ".alpha": "alpha",
}


def merge_lora(unet: nn.Module, state: Mapping[str, torch.Tensor], what: str) -> int:
    """Add the LoRA `state` to `unet`; returns how many layers changed.

    Products are computed in float32 whatever the type of the weights.

    Raises:
        InputError: tensors of another model, or no LoRA at all; `what` names the file.
    """
    layers = {name.replace(".", "_"): name for name, module in unet.named_modules() if _is_layer(module)}
    parts = _parts(state, layers, what)
    for name, part in parts.items():
        if not {"down", "up"} <= set(part):
            raise InputError(f"{what} lacks one half of the layer '{name}'; get the file again.")
        module: Any = unet.get_submodule(name)
        down, up, alpha = part["down"], part["up"], part.get("alpha")
        fit = down.ndim > 1 and up.ndim > 1 and 0 < len(down) == up.shape[1]
        if not fit or (alpha is not None and alpha.numel() != 1):
            raise InputError(f"{what} has two halves of the layer '{name}' that do not fit; get the file again.")
        change = lora_change(down, up, alpha)
        if change.shape != module.weight.shape:
            raise InputError(
                f"{what} changes '{name}' as {tuple(change.shape)}, but the base model has "
                f"{tuple(module.weight.shape)} there; choose the LoRA for Stable Diffusion 1.5."
            )
        with torch.no_grad():
            module.weight.copy_((module.weight.float() + change.to(module.weight.device)).to(module.weight.dtype))
    return len(parts)


def lora_change(down: torch.Tensor, up: torch.Tensor, alpha: torch.Tensor | None) -> torch.Tensor:
    """(alpha / rank) B A in float32 for linear layers, or convolutions whose `down` has the kernel."""
    rank = down.shape[0]
    scale = 1.0 if alpha is None else float(alpha) / rank
    product = up.float().flatten(1) @ down.float().flatten(1)
    return scale * product.reshape(up.shape[0], *down.shape[1:])


def _is_layer(module: nn.Module) -> bool:
    return isinstance(module, (nn.Linear, nn.Conv2d))


def _parts(
    state: Mapping[str, torch.Tensor], layers: Mapping[str, str], what: str
) -> dict[str, dict[str, torch.Tensor]]:
    found: dict[str, dict[str, torch.Tensor]] = {}
    for key, tensor in state.items():
        suffix = next((ending for ending in _SUFFIXES if key.endswith(ending)), None)
        if suffix is None:
            raise InputError(f"{what} holds '{key}', which is no part of a LoRA; choose the LCM-LoRA's file.")
        stem = key.removesuffix(suffix)
        flat = stem.removeprefix("lora_unet_").removeprefix("unet.").replace(".", "_")
        if flat not in layers:
            raise InputError(
                f"{what} changes '{stem}', which the base model lacks; choose the LoRA for Stable Diffusion 1.5."
            )
        found.setdefault(layers[flat], {})[_SUFFIXES[suffix]] = tensor
    if not found:
        raise InputError(f"{what} is empty; get the file again.")
    return found
