# SPDX-License-Identifier: GPL-3.0-or-later
"""Networks on disk: safetensors, with what they were trained on in the metadata.

A model is one network or several of a shape, trained alike from different seeds, whose answers are averaged.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import InputError
from ...files import replaced
from ...rig.bone_roles import ROLES

if TYPE_CHECKING:
    from .network import PriorNetwork

FORMAT = "gskin-prior-2"
SHIPPED = Path(__file__).with_name("prior.safetensors")


@dataclass(frozen=True)
class ModelCard:
    """What a model file says of itself: the families that it never saw, and how it was trained."""

    left_out: tuple[str, ...]
    families: tuple[str, ...]
    training: Mapping[str, Any]


def save_model(networks: Sequence[PriorNetwork], path: Path, card: ModelCard) -> None:
    """Write half-precision weights; the file appears whole or not at all. All networks have the shape of the first."""
    import torch
    from safetensors.torch import save_file

    from .features import NAMES

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
    # One entry only: safetensors keeps several in an order of its own, and equal trainings shall give equal bytes.
    metadata = {FORMAT: json.dumps(about)}
    with replaced(path) as temporary:
        save_file(tensors, temporary, metadata)


def read_card(path: Path) -> ModelCard:
    """The metadata of a model file.

    Raises:
        InputError: the file is missing or no model of this program.
    """
    about = _open(path, tensors=False)[0]
    return ModelCard(tuple(about["left_out"]), tuple(about["families"]), about["training"])


def load_model(path: Path) -> tuple[PriorNetwork, ...]:
    """The networks of a model file, ready to predict.

    Raises:
        InputError: the file is missing, or no model of this program, or of another version.
    """
    import torch

    from .features import NAMES
    from .network import PriorNetwork, Shape

    about, tensors = _open(path)
    if tuple(about["features"]) != NAMES or tuple(about.get("roles", ())) != ROLES:
        raise InputError(f"'{path}' was trained by another version of gskin; train it again with gskin train-prior.")
    try:
        networks = tuple(PriorNetwork(Shape(**about["shape"])) for _ in range(about["networks"]))
        for number, network in enumerate(networks):
            start = f"{number}."
            own = {k.removeprefix(start): v.to(torch.float32) for k, v in tensors.items() if k.startswith(start)}
            network.load_state_dict(own)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"'{path}' does not hold the weights that it says; train it again.") from error
    return tuple(network.eval() for network in networks)


def models_without(family: str, folder: Path) -> Path | None:
    """A model file in `folder` that never saw `family`; None where there is none. The first by name."""
    for path in sorted(folder.glob("*.safetensors")):
        if family in read_card(path).left_out:
            return path
    return None


def _open(path: Path, *, tensors: bool = True) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the file says of itself, and its tensors by name."""
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise InputError(
            "The learned weights need the package safetensors in the worker's Python; "
            "install it with pip install safetensors, or choose other initial weights."
        ) from error
    if not path.is_file():
        raise InputError(f"The model '{path}' does not exist; name a file made by gskin train-prior.")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            found = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"'{path}' is no safetensors file; name one made by gskin train-prior.") from error
    if FORMAT not in metadata:
        raise InputError(f"'{path}' holds no prior of gskin; name a file made by gskin train-prior.")
    try:
        about: dict[str, Any] = json.loads(metadata[FORMAT])
        missing = {"networks", "shape", "features", "left_out", "families", "training"} - set(about)
    except (ValueError, TypeError) as error:
        raise InputError(f"'{path}' has broken metadata; train it again with gskin train-prior.") from error
    if missing:
        raise InputError(f"'{path}' has broken metadata; train it again with gskin train-prior.")
    return about, found
