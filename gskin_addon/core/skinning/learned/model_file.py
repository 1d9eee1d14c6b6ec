# SPDX-License-Identifier: GPL-3.0-or-later
"""Networks on disk: safetensors, with what they were trained on in the metadata.

A model is one network or several of a shape, trained alike from different seeds, whose answers are averaged.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...rig.bone_roles import ROLES
from .features import NAMES
from .network import PriorNetwork, Shape, parameter_shapes
from .safetensors import read_safetensors

FORMAT = "gskin-prior-2"
SHIPPED = Path(__file__).with_name("prior.safetensors")

_LARGEST = 4096  # of any size of a network
_NOTHING = np.zeros(0, np.float32)


@dataclass(frozen=True)
class ModelCard:
    """What a model file says of itself: the families that it never saw, and how it was trained."""

    left_out: tuple[str, ...]
    families: tuple[str, ...]
    training: Mapping[str, Any]


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
    about, tensors = _open(path)
    if tuple(about["features"]) != NAMES or tuple(about.get("roles", ())) != ROLES:
        raise InputError(f"'{path}' was trained by another version of gskin; train it again with gskin train-prior.")
    try:
        shape, number = _shape(about["shape"]), about["networks"]
        if type(number) is not int or not 0 < number <= len(tensors):
            raise ValueError("no networks")
        if not all(np.isfinite(tensor).all() and tensor.dtype.kind == "f" for tensor in tensors.values()):
            raise ValueError("numbers that are not finite")
        return tuple(
            PriorNetwork(shape, {name: tensors.get(f"{i}.{name}", _NOTHING) for name in parameter_shapes(shape)})
            for i in range(number)
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"'{path}' does not hold the weights that it says; train it again.") from error


def models_without(family: str, folder: Path) -> Path | None:
    """A model file in `folder` that never saw `family`; None where there is none. The first by name."""
    for path in sorted(folder.glob("*.safetensors")):
        if family in read_card(path).left_out:
            return path
    return None


def _shape(sizes: Any) -> Shape:
    shape = Shape(**sizes)
    numbers = list(shape.as_dict().values())
    if not all(type(n) is int and 0 <= n <= _LARGEST for n in numbers) or shape.heads < 1:
        raise ValueError("sizes that no network has")
    if shape.width % shape.heads or shape.features != len(NAMES) or shape.roles != len(ROLES):
        raise ValueError("sizes that do not fit together")
    return shape


def _open(path: Path, *, tensors: bool = True) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the file says of itself, and its tensors by name."""
    if not path.is_file():
        raise InputError(f"The model '{path}' does not exist; name a file made by gskin train-prior.")
    try:
        metadata, found = read_safetensors(path, tensors=tensors)
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' is no safetensors file; name one made by gskin train-prior.") from error
    if FORMAT not in metadata:
        raise InputError(f"'{path}' holds no prior of gskin; name a file made by gskin train-prior.")
    try:
        about: dict[str, Any] = json.loads(metadata[FORMAT])
        missing = {"networks", "shape", "features", "left_out", "families", "training"} - set(about)
    except (ValueError, TypeError) as error:
        raise InputError(f"'{path}' has broken metadata; train it again with gskin train-prior.") from error
    if missing or not isinstance(about, dict):
        raise InputError(f"'{path}' has broken metadata; train it again with gskin train-prior.")
    lists = [about.get(name, []) for name in ("features", "roles", "left_out", "families")]
    words = all(isinstance(part, list) and all(isinstance(word, str) for word in part) for part in lists)
    if not words or not isinstance(about["training"], dict):
        raise InputError(f"'{path}' has broken metadata; train it again with gskin train-prior.")
    return about, found
