# SPDX-License-Identifier: GPL-3.0-or-later
"""The cache: one JSON line for each (asset, method, skeleton, protocol), and the weights beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

OWN = "own"
"""The name of the asset's own skeleton, among the disturbed ones."""

OK, PARTLY, FAILED = "ok", "partly", "failed"


@dataclass(frozen=True)
class Result:
    """One method on one asset.

    status: OK; PARTLY, where the method left splats without weights; FAILED, where it gave none. What it left
    out follows the nearest bone and is scored so. seconds: core-seconds, None where nobody knows. score: the fields of
    judge.Score.
    """

    asset: str
    category: str
    family: str
    method: str
    skeleton: str
    protocol: str
    bones: int
    status: str
    note: str
    seconds: float | None
    score: dict[str, float | None]

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What the cache knows a result by."""
        return self.asset, self.method, self.skeleton, self.protocol


class Store:
    """The results in `folder`/results.jsonl; of lines with one key the last counts.

    Half a line at the end, from a run that was killed, is ignored and closed by the next one.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._path = folder / "results.jsonl"
        self._results: dict[tuple[str, str, str, str], Result] = {}
        self._half = False
        text = self._path.read_text(encoding="utf-8") if self._path.is_file() else ""
        for line in text.splitlines():
            try:
                result = Result(**json.loads(line))
            except (json.JSONDecodeError, TypeError):
                continue
            self._results[result.key] = result
        self._half = bool(text) and not text.endswith("\n")

    def get(self, key: tuple[str, str, str, str]) -> Result | None:
        """The result with this key, if there is one."""
        return self._results.get(key)

    def __iter__(self) -> Iterator[Result]:
        return iter(self._results.values())

    def add(self, result: Result) -> None:
        """Keep a result, on disk at once."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(("\n" if self._half else "") + json.dumps(asdict(result)) + "\n")
        self._half = False
        self._results[result.key] = result


def weights_path(folder: Path, asset: str, method: str, protocol: str) -> Path:
    """Where the weights of a method on an asset's own skeleton are kept, for pictures."""
    safe = "".join(c if c.isalnum() or c in "-_+" else "-" for c in method)
    return folder / "weights" / protocol / f"{asset}.{safe}.npz"


def save_weights(path: Path, weights: NDArray[Any]) -> None:
    """Keep weights (N, B) in half precision; the file appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, weights=np.asarray(weights, np.float16))
    os.replace(temporary, path)


def load_weights(path: Path) -> NDArray[np.float32]:
    """Weights (N, B) that `save_weights` kept, rows sum to 1."""
    with np.load(path) as file:
        weights = file["weights"].astype(np.float32)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
