# SPDX-License-Identifier: GPL-3.0-or-later
"""From results to numbers: means, ratios to the initial weights, shares, and the acceptance lines."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .results import FAILED, OWN, PARTLY, Result

BASE, MESH, OURS = "initial", "heat_mesh", "ours:default"
"""What ratios refer to, what must be beaten, and what is accepted or not."""

_LEAST = 1e-3  # % of the diagonal: an error below it counts as it, so that a ratio of two nothings is 1


@dataclass(frozen=True)
class Line:
    """One line of acceptance: at_most says whether the value may not exceed the target or must reach it."""

    name: str
    value: float
    target: float
    at_most: bool

    def __str__(self) -> str:
        good = self.value <= self.target if self.at_most else self.value >= self.target
        sign = "<=" if self.at_most else ">="
        return f"{self.name} {self.value:.3f} {sign}{self.target:.3f} {'ok' if good else 'MISS'}"


class Summary:
    """Results of one protocol, by method, skeleton and asset."""

    def __init__(self, results: Iterable[Result], protocol: str) -> None:
        self._all = [r for r in results if r.protocol == protocol]
        self._by = {(r.method, r.skeleton, r.asset): r for r in self._all}

    def methods(self) -> list[str]:
        """The methods that have results on own skeletons, in the order of the first ones."""
        return list(dict.fromkeys(r.method for r in self._all if r.skeleton == OWN))

    def of(self, method: str, skeleton: str = OWN, category: str | None = None) -> list[Result]:
        """The results of a method, by asset."""
        found = [r for r in self._all if r.method == method and r.skeleton == skeleton]
        return sorted((r for r in found if category in (None, r.category)), key=lambda r: r.asset)

    def common(self, methods: Sequence[str], skeletons: Sequence[str] = (OWN,)) -> list[str]:
        """The assets that have a result of each of the methods on each of the skeletons."""
        sets = [{r.asset for r in self.of(m, s)} for m in methods for s in skeletons]
        return sorted(set.intersection(*sets)) if sets else []

    def only(self, assets: Sequence[str]) -> Summary:
        """The same for some of the assets."""
        chosen = Summary((), "")
        chosen._all = [r for r in self._all if r.asset in assets]
        chosen._by = {key: r for key, r in self._by.items() if r.asset in assets}
        return chosen

    def mean(
        self, method: str, field: str, *, skeleton: str = OWN, category: str | None = None,
        assets: Sequence[str] | None = None,
    ) -> float:  # fmt: skip
        """Mean of a field of the score, over the assets that have it; NaN without any."""
        values = [
            r.score[field]
            for r in self.of(method, skeleton, category)
            if r.score.get(field) is not None and (assets is None or r.asset in assets)
        ]
        return float(np.mean(values)) if values else float("nan")

    def pairs(
        self, method: str, other: str, field: str, category: str | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The field of both methods, on the assets that both have."""
        both = [
            (r.score[field], self._by[other, OWN, r.asset].score[field])
            for r in self.of(method, OWN, category)
            if (other, OWN, r.asset) in self._by
        ]
        array = np.array(both, float).reshape(-1, 2)
        return array[:, 0], array[:, 1]

    def ratio(self, method: str, field: str = "error") -> float:
        """Mean over the assets of the error over that of the initial weights."""
        mine, base = self.pairs(method, BASE, field)
        return float(np.mean(np.maximum(mine, _LEAST) / np.maximum(base, _LEAST))) if len(mine) else float("nan")

    def share(self, method: str, other: str, better: Callable[..., np.ndarray], field: str = "error") -> float:
        """Share of the assets where better(method's, other's)."""
        mine, theirs = self.pairs(method, other, field)
        return float(np.mean(better(mine, theirs))) if len(mine) else float("nan")

    def worse_than_initial(self, method: str, field: str = "error") -> float:
        """Share of the assets on which the error is larger than that of the initial weights."""
        return self.share(method, BASE, np.greater, field)

    def beats_mesh(self, method: str, field: str = "error") -> float:
        """Share of the assets on which the error is smaller than that of bone heat on the true mesh."""
        return self.share(method, MESH, np.less, field)

    def seconds(self, method: str) -> float:
        """Median core-seconds to make the weights."""
        found = [r.seconds for r in self.of(method) if r.status != FAILED and r.seconds is not None]
        return float(np.median(found)) if found else float("nan")

    def failures(self) -> list[Result]:
        """What did not work, or only in part."""
        return sorted(
            (r for r in self._all if r.status in (FAILED, PARTLY)), key=lambda r: (r.method, r.skeleton, r.asset)
        )


def acceptance(summary: Summary, method: str = OURS) -> list[Line]:
    """What is asked for, on the assets' own animations and, by their names, in random poses; empty without results."""
    if not summary.of(method):
        return []
    lines = []
    for field, tail in (("error", ""), ("random_error", " (random poses)")):
        lines.append(Line(f"ratio to initial{tail}", summary.ratio(method, field), 0.35, True))
        for category in (None, "humanoid", "animal", "creature"):
            mine, mesh = summary.pairs(method, MESH, field, category)
            if len(mine):
                name = f"error against bone heat on the true mesh, {category or 'all'}{tail}"
                lines.append(Line(name, float(mine.mean()), float(mesh.mean()), True))
        lines.append(Line(f"share better than bone heat{tail}", summary.beats_mesh(method, field), 0.65, False))
        lines.append(Line(f"share worse than initial{tail}", summary.worse_than_initial(method, field), 0.03, True))
    mine, base = summary.pairs(method, BASE, "psnr")
    lines.append(Line("PSNR gain in dB", float(np.mean(mine - base)), 4.0, False))
    return [line for line in lines if np.isfinite(line.value)]
