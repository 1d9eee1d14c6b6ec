# SPDX-License-Identifier: GPL-3.0-or-later
"""Skinning weights as a file, with the bones that they belong to: an .npz without pickled objects.

weights (N, B) float32, rows sum to 1; bones (B,) names; heads, tails (B, 3) and parents (B,); where there are such
also mesh_weights (V, B) of a proxy mesh's vertices, confidence (N,) in 0..1, and what the weights started from:
start_bones, start_weights (N, K), the strongest bones of each splat.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays, write_arrays
from .influences import Influences
from .skeleton import Skeleton

_ARRAYS = ("weights", "bones", "heads", "tails", "parents")
_OPTIONAL = ("mesh_weights", "confidence", "start_bones", "start_weights")


@dataclass(frozen=True)
class WeightsFile:
    """What such a file holds.

    weights: (N, B) float32, rows sum to 1. bones: B names. heads, tails: (B, 3) float64 metres, world space.
    parents: (B,) index, -1 for a root. mesh_weights: (V, B) float32, or None. confidence: (N,) float32 in 0..1,
    or None. start: the weights before learning, or None.
    """

    weights: NDArray[np.float32]
    bones: tuple[str, ...]
    heads: NDArray[np.float64]
    tails: NDArray[np.float64]
    parents: NDArray[np.int64]
    mesh_weights: NDArray[np.float32] | None = None
    confidence: NDArray[np.float32] | None = None
    start: Influences | None = None


def write_weights_file(
    path: str | Path,
    weights: NDArray[Any],
    skeleton: Skeleton,
    mesh_weights: NDArray[Any] | None = None,
    confidence: NDArray[Any] | None = None,
    start: Influences | None = None,
) -> None:
    """Write `weights` (N, B), `mesh_weights` (V, B), `confidence` (N,), `start`, with the bones they belong to.

    Raises:
        ValueError: not (N, B), not finite, negative, or rows that do not sum to 1 (1e-3); confidence not (N,) in 0..1;
            a start of another shape or other bones.
        GSkinError: the file cannot be written.
    """
    arrays = {"weights": weights} if mesh_weights is None else {"weights": weights, "mesh_weights": mesh_weights}
    for values in arrays.values():
        fault = _fault_in(values, skeleton.count)
        if fault:
            raise ValueError(fault)
    if confidence is not None:
        fault = _fault_in_confidence(confidence, len(weights))
        if fault:
            raise ValueError(fault)
        arrays["confidence"] = confidence
    before: dict[str, NDArray[Any]] = {}
    if start is not None:
        fault = start.fault(len(weights), skeleton.count)
        if fault:
            raise ValueError(fault)
        before = {"start_bones": start.index.astype(np.int32), "start_weights": start.value.astype(np.float32)}
    write_arrays(
        Path(path),
        {
            **before,
            **{name: np.ascontiguousarray(values, dtype=np.float32) for name, values in arrays.items()},
            "bones": np.array(skeleton.names, dtype=np.str_),
            "heads": np.asarray(skeleton.heads, dtype=np.float64),
            "tails": np.asarray(skeleton.tails, dtype=np.float64),
            "parents": np.asarray(skeleton.parents, dtype=np.int64),
        },
    )


def read_weights_file(path: str | Path) -> WeightsFile:
    """Read what `write_weights_file` wrote.

    Raises:
        InputError: missing, damaged, or weights that are not (N, B) rows summing to 1.
    """
    path = Path(path)
    try:
        arrays = read_arrays(path, _ARRAYS, _OPTIONAL)
        if arrays["bones"].ndim != 1 or arrays["bones"].dtype.kind != "U":
            raise ValueError("its bones are no names")
        names = tuple(str(name) for name in arrays["bones"])
        skeleton = Skeleton(names, *(arrays[name] for name in ("parents", "heads", "tails")))
    except FileNotFoundError:
        raise InputError(f"'{path}' does not exist; name the weights that gskin wrote.") from None
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"'{path}' does not hold skinning weights ({error}); make it again with gskin.") from None
    on_mesh, confidence = arrays.get("mesh_weights"), arrays.get("confidence")
    for values in (arrays["weights"], on_mesh):
        fault = "" if values is None else _fault_in(values, skeleton.count)
        if fault:
            raise InputError(f"'{path}' does not hold skinning weights ({fault}); make it again with gskin.")
    fault = "" if confidence is None else _fault_in_confidence(confidence, len(arrays["weights"]))
    if fault:
        raise InputError(f"'{path}' has a damaged confidence ({fault}); make it again with gskin.")
    start = _start(arrays)
    fault = "" if start is None else start.fault(len(arrays["weights"]), skeleton.count)
    if fault:
        raise InputError(f"'{path}' has damaged weights to start from ({fault}); make it again with gskin.")
    return WeightsFile(
        weights=arrays["weights"].astype(np.float32, copy=False),
        bones=skeleton.names,
        heads=skeleton.heads,
        tails=skeleton.tails,
        parents=skeleton.parents,
        mesh_weights=None if on_mesh is None else on_mesh.astype(np.float32, copy=False),
        confidence=None if confidence is None else confidence.astype(np.float32, copy=False),
        start=start,
    )


def _start(arrays: dict[str, NDArray[Any]]) -> Influences | None:
    index, value = arrays.get("start_bones"), arrays.get("start_weights")
    return None if index is None or value is None else Influences(index, value)


def _fault_in(weights: NDArray[Any], bones: int) -> str:
    if weights.ndim != 2 or weights.shape[1] != bones or weights.dtype.kind != "f":
        return f"an array {weights.shape} of {weights.dtype} for {bones} bones"
    if not np.isfinite(weights).all():
        return "values that are not finite numbers"
    if (weights < 0).any():
        return "negative weights"
    if len(weights) and float(np.abs(weights.sum(axis=1, dtype=np.float64) - 1.0).max()) > 1e-3:
        return "rows that do not sum to 1"
    return ""


def _fault_in_confidence(confidence: NDArray[Any], count: int) -> str:
    if confidence.shape != (count,) or confidence.dtype.kind != "f":
        return f"an array {confidence.shape} of {confidence.dtype} for {count} splats"
    return "" if ((confidence >= 0) & (confidence <= 1)).all() else "values outside 0..1"
