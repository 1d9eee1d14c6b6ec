# SPDX-License-Identifier: GPL-3.0-or-later
"""Joints from votes: every voxel of a body's surface says where it believes each joint to be, and how much that counts.

A small network in numpy alone: what is trained is core/training/skeleton/train.py, with the same parameters. Votes of
parts for joints are those of Girshick et al. 2011 (regression of joints by offsets); one network for the left
side sees the body and its mirror image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .body_shape import REACHES, BodyShape

Array = NDArray[Any]

FEATURES = 3 + len(REACHES) + 3 * len(REACHES) + 4 + 3 + 3 + 3
_MIRRORED = np.array(
    [0, *(3 + len(REACHES) + 3 * n for n in range(len(REACHES))), FEATURES - 9, FEATURES - 6], np.int64
)
"""The features that change their sign in the mirror."""


def features(shape: BodyShape, scale: float) -> Array:
    """(M, FEATURES) float32 of a body that stands on the floor at z = 0, looks along -y, has its middle at x = y = 0,
    and whose unit of length is `scale` metres."""
    box = np.broadcast_to((shape.high - shape.low) / scale, shape.points.shape)
    parts = (
        shape.points / scale,
        shape.filled,
        shape.lean.reshape(len(shape.points), -1) / scale,
        np.stack([shape.below, shape.above, shape.inside, shape.beyond], axis=1) / scale,
        (shape.end - shape.points) / scale,
        shape.end / scale,
        box,
    )
    return np.concatenate(parts, axis=1).astype(np.float32)


def mirrored(values: Array) -> Array:
    """Features (..., FEATURES) of the mirror image."""
    out = values.copy()
    out[..., _MIRRORED] *= -1
    return out


@dataclass(frozen=True)
class Votes:
    """joints (J, 3); spread (J,): how far the votes lie from them, in the mean; fits: how much the body looks like
    one that stands as it should, a logit."""

    joints: Array
    spread: Array
    fits: float


def parameter_shapes(joints: int, width: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all that is learned."""
    layers = {
        "enter.0": (FEATURES, width), "enter.2": (width, width), "whole": (2 * width, width),
        "mix": (2 * width, width), "say": (width, 4 * joints), "look.0": (2 * width, width // 2),
        "look.2": (width // 2, 1),
    }  # fmt: skip
    out: dict[str, tuple[int, ...]] = {"mean": (FEATURES,), "deviation": (FEATURES,)}
    for name, (inputs, outputs) in layers.items():
        out[f"{name}.weight"], out[f"{name}.bias"] = (outputs, inputs), (outputs,)
    return out


class VoteNetwork:
    """Where the joints of the left side and of the middle are."""

    def __init__(self, parameters: Mapping[str, Array]) -> None:
        """parameters: by the names of `parameter_shapes`.

        Raises:
            ValueError: one is missing or has another shape.
        """
        width, joints = len(parameters["mix.bias"]), len(parameters["say.bias"]) // 4
        for name, wanted in parameter_shapes(joints, width).items():
            if name not in parameters or parameters[name].shape != wanted:
                raise ValueError(f"'{name}' is missing or not of shape {wanted}")
        self.parameters = {name: np.asarray(value, np.float32) for name, value in parameters.items()}

    def __call__(self, values: Array) -> Votes:
        """The votes of voxels with `features` (M, FEATURES); lengths in their unit."""
        own = self.parameters
        x = (values - own["mean"]) / own["deviation"]
        x = _relu(self._linear("enter.2", _relu(self._linear("enter.0", x))))
        pooled = np.concatenate([x.mean(axis=0), x.max(axis=0)])
        whole = _relu(self._linear("whole", pooled))
        x = _relu(self._linear("mix", np.concatenate([x, np.broadcast_to(whole, x.shape)], axis=1)))
        said = self._linear("say", x).reshape(len(values), -1, 4)
        weight = np.exp(said[..., 0] - said[..., 0].max(axis=0))
        weight /= weight.sum(axis=0)
        places = values[:, None, :3] + said[..., 1:]
        joints = np.einsum("mj,mjk->jk", weight, places)
        spread = np.einsum("mj,mj->j", weight, np.linalg.norm(places - joints, axis=2))
        looks = self._linear("look.2", _relu(self._linear("look.0", pooled)))
        return Votes(joints, spread, float(looks[0]))

    def _linear(self, name: str, x: Array) -> Array:
        return np.asarray(x @ self.parameters[f"{name}.weight"].T + self.parameters[f"{name}.bias"])


def _relu(x: Array) -> Array:
    return np.maximum(x, 0, out=x)
