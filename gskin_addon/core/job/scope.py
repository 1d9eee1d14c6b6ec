# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job keeps of the present state: weights to start from, the splats that may change, and walls. numpy only."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..skinning.walls import nearest_open

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Scope:
    """present (N, B) float32: weights that the splats have now, in the order of the job's bones, rows sum to 1, or are
    zeros where a splat has none, see `filled`;
    only (K,): indices of the splats whose weights may change, all where left out; walls (N,): a label for each splat, 0
    for none: distances, heat and smoothing do not go from one splat to another where both have labels and they differ.
    """

    present: NDArray[np.float32] | None = None
    only: NDArray[np.int64] | None = None
    walls: NDArray[np.int64] | None = None

    @property
    def empty(self) -> bool:
        """Whether the job is free to change everything, knowing nothing."""
        return self.present is None and self.only is None and self.walls is None

    def movable(self, count: int) -> NDArray[np.bool_]:
        """Splats (N,) whose weights may change."""
        mask = np.ones(count, bool)
        if self.only is not None:
            mask[:] = False
            mask[self.only] = True
        return mask

    def filled(self, means: Array) -> Scope:
        """The same where splats at means (N, 3) without present weights have those of the nearest splat with some that
        no wall separates from them: learning starts from weights of every splat."""
        if self.present is None:
            return self
        known = self.present.any(axis=1)
        if known.all():
            return self
        present, labels = self.present.copy(), self.walls
        own = (None, None) if labels is None else (labels[known], labels[~known])
        _, nearest = nearest_open(means[known], means[~known], *own)
        present[~known] = present[known][nearest]
        return replace(self, present=present)

    def checked(self, splats: int, bones: int, label: str = "The job's scope") -> Scope:
        """The same with the types above.

        Raises:
            InputError: arrays that do not fit `splats` and `bones`, weights of no splat, rows of weights that do not
                sum to 1, indices that are no splats or come twice, `only` without weights for the others.
        """
        present = self.present
        if present is not None:
            if present.shape != (splats, bones) or present.dtype.kind != "f":
                raise InputError(
                    f"{label} has present weights {present.shape} of {present.dtype} for {splats} splats and {bones} "
                    "bones; make them from the same splats and armature."
                )
            sums = present.sum(axis=1, dtype=np.float64)
            off = np.where(sums == 0, 0, np.abs(sums - 1))
            if not np.isfinite(present).all() or (present < 0).any() or off.max(initial=0) > 1e-3:
                raise InputError(f"{label} has present weights whose rows do not sum to 1; normalise them first.")
            if not sums.any():
                raise InputError(f"{label} has no splat with weights to start from; run Auto-Skin for all of them.")
            present = present.astype(np.float32, copy=False)
        only = self.only
        if only is not None:
            if only.ndim != 1 or only.dtype.kind not in "iu" or not len(only):
                raise InputError(f"{label} names no splats that may change; select some, or leave 'only' out.")
            only = only.astype(np.int64, copy=False)
            if only.min() < 0 or only.max() >= splats or len(np.unique(only)) != len(only):
                raise InputError(f"{label} names splats outside 0 to {splats - 1}, or some twice; select them again.")
            if present is None:
                raise InputError(f"{label} limits the change to some splats but has no weights for the rest; add them.")
        walls = self.walls
        if walls is not None:
            if walls.shape != (splats,) or walls.dtype.kind not in "iu":
                raise InputError(
                    f"{label} has walls {walls.shape} of {walls.dtype} for {splats} splats; mark them again."
                )
            walls = walls.astype(np.int64, copy=False)
        return Scope(present, only, walls)


def scope_file(scope: Scope) -> tuple[str, dict[str, Array]]:
    """Name and arrays of a scope's file in a job's folder, for `prepare_job`; the name is the job's setting `scope`.

    Another scope has another name.
    """
    arrays = {name: array for name, array in vars(scope).items() if array is not None}
    digest = hashlib.blake2b(digest_size=8)
    for name, array in arrays.items():
        digest.update(name.encode())
        digest.update(str((array.shape, array.dtype)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"scope-{digest.hexdigest()}.npz", arrays


def read_scope(path: Path, splats: int, bones: int) -> Scope:
    """The scope in `path`, checked.

    Raises:
        InputError: missing, damaged, or it does not fit.
    """
    if not path.is_file():
        raise InputError(f"'{path}' is missing; '{path.parent}' is not a whole job, write it again.")
    try:
        arrays = read_arrays(path, (), ("present", "only", "walls"))
        if not arrays:
            raise ValueError("it has none of present, only and walls")
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' is damaged or not an .npz of numbers ({error}); write the job again.") from None
    return Scope(**arrays).checked(splats, bones, f"'{path}'")
