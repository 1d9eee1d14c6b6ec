# SPDX-License-Identifier: GPL-3.0-or-later
"""The skeleton: named segments in a forest, one weight channel each.

A bone is the segment head -> tail and turns about its head. That is the paper's bone b between the joint A_b
(head) and the joint b (tail), and it is a Blender bone.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Skeleton:
    """Bones in world space, metres.

    names: B unique strings. parents: (B,) int, -1 for a root; a parent precedes its children.
    heads, tails: (B, 3) float64. rest: (B, 4, 4) float64, each bone's rest matrix in the world; left out, it
    is the identity rotation at the head. `validate` checks the meaning; the constructor only the shapes
    (ValueError).
    """

    names: tuple[str, ...]
    parents: Array
    heads: Array
    tails: Array
    rest: Array = None  # type: ignore[assignment]  # __post_init__ fills it, so readers always see an array

    def __post_init__(self) -> None:
        count = len(self.names)
        rest: Any = self.rest
        if rest is None:
            heads = np.asarray(self.heads, dtype=np.float64)
            rest = np.tile(np.eye(4), (len(heads), 1, 1))
            rest[:, :3, 3] = heads
        for name, value, dtype, shape in (
            ("parents", self.parents, np.int64, (count,)),
            ("heads", self.heads, np.float64, (count, 3)),
            ("tails", self.tails, np.float64, (count, 3)),
            ("rest", rest, np.float64, (count, 4, 4)),
        ):
            array = np.asarray(value, dtype=dtype)
            if array.size == 0:
                array = array.reshape(shape)
            if array.shape != shape:
                raise ValueError(f"skeleton {name} have shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "names", tuple(str(n) for n in self.names))

    @property
    def count(self) -> int:
        """Number of bones."""
        return len(self.names)

    @property
    def lengths(self) -> Array:
        """(B,) bone lengths in metres."""
        return np.linalg.norm(self.tails - self.heads, axis=1)

    @property
    def roots(self) -> Array:
        """Indices of the bones without a parent."""
        return np.flatnonzero(self.parents < 0)

    def children(self, bone: int) -> Array:
        """Indices of the direct children of a bone."""
        return np.flatnonzero(self.parents == bone)

    def subset(self, keep: ArrayLike) -> Skeleton:
        """The skeleton of the kept bones (bool mask (B,) or indices), in their present order.

        A bone whose parent is dropped hangs on its nearest kept ancestor.
        """
        mask = np.zeros(self.count, dtype=bool)
        mask[np.asarray(keep)] = True
        new_index = np.cumsum(mask) - 1
        parents = []
        for bone in np.flatnonzero(mask):
            parent = int(self.parents[bone])
            while parent >= 0 and not mask[parent]:
                parent = int(self.parents[parent])
            parents.append(-1 if parent < 0 else int(new_index[parent]))
        names = tuple(n for n, kept in zip(self.names, mask, strict=True) if kept)
        return Skeleton(names, np.array(parents), self.heads[mask], self.tails[mask], self.rest[mask])

    def moved(
        self, rotation: ArrayLike, scale: float = 1.0, translation: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Skeleton:
        """The skeleton after x -> scale * rotation @ x + translation (rest rotations stay free of scale)."""
        rot, shift = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
        rest = self.rest.copy()
        rest[:, :3, :3] = rot @ self.rest[:, :3, :3]
        rest[:, :3, 3] = scale * self.rest[:, :3, 3] @ rot.T + shift
        heads, tails = scale * self.heads @ rot.T + shift, scale * self.tails @ rot.T + shift
        return Skeleton(self.names, self.parents, heads, tails, rest)

    def validate(self, label: str = "armature") -> None:
        """Raise InputError, naming `label` and the bone, when the skeleton cannot carry weights."""
        if self.count == 0:
            raise InputError(f"{label} has no deform bones; enable Deform on those that carry weights.")
        twice = sorted({n for n in self.names if self.names.count(n) > 1})
        if twice:
            raise InputError(f"{label} has two bones named '{twice[0]}'; rename one.")
        for field in ("heads", "tails", "rest"):
            broken = ~np.isfinite(getattr(self, field)).reshape(self.count, -1).all(axis=1)
            if broken.any():
                bone = self._first(broken)
                raise InputError(f"bone '{bone}' of {label} has NaN or infinite {field}; place it again.")
        early = (self.parents >= np.arange(self.count)) | (self.parents < -1)
        if early.any():
            bone = self._first(early)
            raise InputError(f"bone '{bone}' of {label} comes before its parent; list parents first.")
        extent = float(np.ptp(np.concatenate([self.heads, self.tails]), axis=0).max())
        short = self.lengths <= 1e-7 * max(extent, 1e-30)
        if short.any():
            bone = self._first(short)
            raise InputError(f"bone '{bone}' of {label} has zero length; move its tail or disable Deform.")

    def _first(self, mask: Array) -> str:
        return self.names[int(np.argmax(mask))]

    def to_json(self) -> str:
        """The skeleton as a JSON text that `from_json` reads back exactly."""
        data = {
            "names": list(self.names),
            "parents": self.parents.tolist(),
            "heads": self.heads.tolist(),
            "tails": self.tails.tolist(),
            "rest": self.rest.tolist(),
        }
        return json.dumps(data, indent=1)

    @classmethod
    def from_json(cls, text: str, label: str = "skeleton.json") -> Skeleton:
        """Read what `to_json` wrote (`rest` may be missing); InputError names `label` otherwise."""
        try:
            data = json.loads(text)
            rest = np.array(data["rest"], dtype=np.float64) if data.get("rest") is not None else None
            return cls(
                tuple(data["names"]),
                np.array(data["parents"], dtype=np.int64),
                np.array(data["heads"], dtype=np.float64),
                np.array(data["tails"], dtype=np.float64),
                rest,  # type: ignore[arg-type]
            )
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise InputError(f"{label} is not a skeleton ({error}); export it again.") from error


def parents_first(parents: Sequence[int] | Iterable[int]) -> Array:
    """An order (B,) of bones in which parents precede children, stable otherwise; ValueError on a cycle.

    Index names, heads, tails and rest with it, and map parents through its inverse.
    """
    parent = [int(p) for p in parents]
    depth = []
    for bone in range(len(parent)):
        steps, up = 0, parent[bone]
        while up >= 0:
            steps, up = steps + 1, parent[up]
            if steps > len(parent):
                raise ValueError(f"the parents of bone {bone} form a cycle")
        depth.append(steps)
    # Sorting by depth reorders every skeleton; leave one that is in order already as it is.
    if all(p < b for b, p in enumerate(parent)):
        return np.arange(len(parent))
    return np.argsort(np.array(depth), kind="stable")
