# SPDX-License-Identifier: GPL-3.0-or-later
"""The Gaussian splats of one object, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
AnyArray = NDArray[Any]
Floats = NDArray[np.floating[Any]]

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""

MAX_SH_DEGREE = 4


@dataclass(frozen=True, eq=False)
class SplatCloud:
    """N Gaussian splats.

    means:     (N, 3) centres, metres.
    quats:     (N, 4) unit quaternions, wxyz; they turn the splat's own axes to the cloud's axes.
    scales:    (N, 3) linear standard deviations along the splat's own axes, metres, >= 0.
    opacities: (N,) peak opacity, 0 to 1.
    sh:        (N, (degree + 1)^2, 3) spherical-harmonic coefficients, degree 0-4, one rgb per coefficient.
    extra:     further per-splat values by PLY property name, each (N,), any number type; kept untouched.
    stored:    columns as a file held them (log scale, logit opacity, unnormalised quaternion, doubles), each
               (N,). The writer prefers them wherever they still decode to the values above, so that reading
               and writing loses nothing. Empty for clouds that came from no file.
    offset:    (3,) float64: means + offset are the file's coordinates, along the cloud's axes. Not zero where
               these lie so far from the origin that float32 could not tell splats apart (`georeference.py`).
    notes:     what a reader changed or assumed, for the person: clauses without a full stop.
    up:        the axis of `axes.UP_AXES` that the file itself says is up, "" where it does not.

    Arrays are converted to float32; wrong shapes raise ValueError.
    """

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    opacities: FloatArray
    sh: FloatArray
    extra: Mapping[str, AnyArray] = field(default_factory=dict)
    stored: Mapping[str, AnyArray] = field(default_factory=dict)
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    notes: tuple[str, ...] = ()
    up: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "offset", np.asarray(self.offset, dtype=np.float64))
        if self.offset.shape != (3,):
            raise ValueError(f"offset has shape {self.offset.shape}, expected (3,)")
        for name in ("means", "quats", "scales", "opacities", "sh"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float32))
        count = len(self.means)
        shapes = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")
        whole = [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)]
        if self.sh.ndim != 3 or self.sh.shape[::2] != (count, 3) or self.sh.shape[1] not in whole:
            raise ValueError(f"sh has shape {self.sh.shape}, expected ({count}, K, 3) with K in {whole}")
        for name, column in {**self.extra, **self.stored}.items():
            if column.shape != (count,):
                raise ValueError(f"column {name!r} has shape {column.shape}, expected ({count},)")

    def __len__(self) -> int:
        return self.count

    @property
    def count(self) -> int:
        """Number of splats N."""
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def base_colors(self) -> FloatArray:
        """(N, 3) view-independent colours in 0..1: clip(0.5 + SH_C0 sh[:, 0])."""
        colors: FloatArray = np.clip(0.5 + np.float32(SH_C0) * self.sh[:, 0], 0.0, 1.0, dtype=np.float32)
        return colors

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest centre, (3,) each; ValueError for an empty cloud."""
        return self.means.min(axis=0), self.means.max(axis=0)

    def select(self, index: Any) -> SplatCloud:
        """The splats at `index`: integers (M,), a mask (N,) or a slice; every column follows."""
        return replace(
            self,
            means=self.means[index],
            quats=self.quats[index],
            scales=self.scales[index],
            opacities=self.opacities[index],
            sh=self.sh[index],
            extra={name: column[index] for name, column in self.extra.items()},
            stored={name: column[index] for name, column in self.stored.items()},
        )
