# SPDX-License-Identifier: GPL-3.0-or-later
"""RigNet's text files of rigs (Xu et al. 2020), which other rigging programs write too: joints, tree, and skin weights.

Lines: `joints NAME X Y Z`, `root NAME`, `hier PARENT CHILD`, `skin VERTEX NAME WEIGHT NAME WEIGHT ...`, with vertices
by their place in a mesh file of its own, from 0, and y up.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_text
from ..splats.axes import up_rotation
from .joint_lines import LARGEST, JointLines, numbered_lines
from .skeleton import Skeleton, parents_first
from .weights_file import WeightsFile

Array = NDArray[Any]


def read_rignet(path: Path) -> WeightsFile:
    """Read such a file; bones are the joints, parents first, each with its tail at the middle of its children.

    heads, tails: turned to z up. The skeleton alone, without weights, is `core/skeleton/joint_text.py`'s.

    Raises:
        InputError: missing, no such file, a joint or vertex that does not exist or comes twice, a circle in the tree,
            a vertex without weights.
    """
    lines = _Lines(path)
    for number, words in numbered_lines(path):
        lines.take(number, words)
    return lines.finish()


@dataclass
class _Lines:
    """What the lines said so far."""

    path: Path
    tree: JointLines = field(default_factory=JointLines)
    rows: list[int] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    vertices: list[int] = field(default_factory=list)

    def take(self, number: int, words: list[str]) -> None:
        """One line, split at spaces."""
        if not words:
            return
        kind, *rest = words
        try:
            if kind == "skin" and rest and len(rest) % 2:
                self._skin(int(rest[0]), rest[1::2], [float(value) for value in rest[2::2]])
            elif not self.tree.take(words):
                raise ValueError(f"'{' '.join(words)[:40]}' is no line of a rig")
        except ValueError as error:
            raise InputError(
                f"'{self.path}', line {number}: {error}; choose a file as RigNet writes it, or write it again."
            ) from None

    def _skin(self, vertex: int, names: list[str], values: list[float]) -> None:
        if vertex < 0:
            raise ValueError(f"there is no vertex {vertex}")
        if not all(np.isfinite(values)) or min(values, default=0.0) < 0.0:
            raise ValueError(f"a weight of vertex {vertex} is negative or not finite")
        if sum(values) <= 0.0:
            raise ValueError(f"vertex {vertex} has no weights")
        self.rows += [vertex] * len(names)
        self.columns += names
        self.values += values
        self.vertices.append(vertex)

    def finish(self) -> WeightsFile:
        """All of it, checked."""
        joints = self.tree.joints
        if not joints:
            raise self._wrong("it has no joints")
        unknown = self.tree.unknown(dict.fromkeys(self.columns))
        if unknown is not None:
            raise self._wrong(f"there is no joint '{unknown:.60}'")
        place = {name: number for number, name in enumerate(joints)}
        parents = np.array(self.tree.parent_numbers())
        try:
            order = parents_first(parents)
        except ValueError:
            raise self._wrong("its joints hang in a circle") from None
        heads = np.array(list(joints.values()), np.float64)
        if not np.isfinite(heads).all():
            raise self._wrong("a joint is not at a finite place")
        new = np.empty(len(order), np.int64)
        new[order] = np.arange(len(order))
        parents = np.where(parents[order] < 0, -1, new[parents[order]])
        heads = heads[order] @ up_rotation("y").T
        names = tuple(np.array(list(joints), object)[order])
        return WeightsFile(self._weights(new, place), names, heads, tails_of(parents, heads), parents)

    def _weights(self, new: Array, place: dict[str, int]) -> Array:
        count = len(self.vertices)
        if not count:
            raise self._wrong("it has no skin weights")
        if len(set(self.vertices)) != count or max(self.vertices) != count - 1:
            raise self._wrong(f"its {count:,} skin lines are not one for each vertex from 0 to {count - 1:,}")
        if count * len(place) > LARGEST:
            raise self._wrong(f"{count:,} vertices of {len(place):,} joints are more than fits in memory")
        weights = np.zeros((count, len(place)), np.float32)
        column = np.array([new[place[name]] for name in self.columns])
        np.add.at(weights, (np.array(self.rows), column), np.array(self.values, np.float32))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)

    def _wrong(self, why: str) -> InputError:
        return InputError(f"'{self.path}' is no whole rig: {why}; write it again.")


def write_rignet(path: Path, weights: Array, skeleton: Skeleton) -> None:
    """Write joints at the bones' heads, turned to y up, their tree, and weights (N, B).

    Names have no spaces there: "_" stands for them. Bones without a parent hang on the first of them, since such a file
    has one root.

    Raises:
        InputError: two bones would have one name. GSkinError: the file cannot be written.
    """
    names = file_names(skeleton.names)
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"Two bones would both be called '{twice}' in '{path}', which has no spaces; rename one.")
    heads = skeleton.heads @ up_rotation("y")
    lines = [f"joints {name} {x:.8g} {y:.8g} {z:.8g}" for name, (x, y, z) in zip(names, heads.tolist(), strict=True)]
    root = int(skeleton.roots[0])
    lines.append(f"root {names[root]}")
    for bone, parent in enumerate(skeleton.parents.tolist()):
        if bone != root:
            lines.append(f"hier {names[parent if parent >= 0 else root]} {names[bone]}")
    rows, columns = np.nonzero(weights)
    values = np.asarray(weights)[rows, columns].tolist()
    ends = np.searchsorted(rows, np.arange(len(weights) + 1)).tolist()
    named = [names[column] for column in columns.tolist()]
    for row in range(len(weights)):
        pairs = [f"{named[i]} {values[i]:.6g}" for i in range(ends[row], ends[row + 1])]
        lines.append(" ".join([f"skin {row}", *pairs]))
    write_text(path, "\n".join(lines) + "\n")


def file_names(names: tuple[str, ...] | list[str]) -> list[str]:
    """Names of bones as such a file has them."""
    return ["_".join(name.split()) or "_" for name in names]


def tails_of(parents: Array, heads: Array) -> Array:
    """(B, 3) tails for bones that have only heads (B, 3): the middle of the children's heads; a leaf goes on as its
    parent came, half as far; a bone alone points up. parents (B,): index, -1 for a root."""
    count = len(heads)
    size = float(np.linalg.norm(np.ptp(heads, axis=0))) or 1.0
    tails = np.zeros((count, 3))
    for bone in range(count):
        children = heads[parents == bone]
        parent = int(parents[bone])
        if len(children):
            tails[bone] = children.mean(axis=0)
        elif parent >= 0:
            tails[bone] = heads[bone] + 0.5 * (heads[bone] - heads[parent])
        if np.linalg.norm(tails[bone] - heads[bone]) < 1e-3 * size or (not len(children) and parent < 0):
            tails[bone] = heads[bone] + [0, 0, 0.05 * size]
    return tails
