# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes trained networks as a model file, see core/skinning/learned/model_file.py."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file

from ...files import replaced
from ...rig.bone_roles import ROLES
from ...skinning.learned.features import NAMES
from ...skinning.learned.model_file import FORMAT, ModelCard
from .torch_network import PriorNetwork


def save_model(networks: Sequence[PriorNetwork], path: Path, card: ModelCard) -> None:
    """Write half-precision weights; the file is written atomically. All networks have the shape of the first."""
    tensors = {
        f"{number}.{name}": value.to(torch.float16 if value.ndim == 2 else torch.float32).contiguous()
        for number, network in enumerate(networks)
        for name, value in network.state_dict().items()
    }
    about = {
        "networks": len(networks),
        "shape": networks[0].shape.as_dict(),
        "features": NAMES,
        "roles": ROLES,
        "left_out": card.left_out,
        "families": card.families,
        "training": dict(card.training),
    }
    # One entry only: safetensors does not keep the order of several, and equal trainings must give equal bytes.
    metadata = {FORMAT: json.dumps(about)}
    with replaced(path) as temporary:
        save_file(tensors, temporary, metadata)
