# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthetic rigs made of bones and tapered capsules, and splats on the outside of the capsules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.skeleton import Skeleton

Array = NDArray[Any]
MIRROR = np.array([-1.0, 1.0, 1.0])
BLEND_BY_DISTANCE = 0.3
"""Share of the creatures whose weights blend by the distances to the bones, not by the depth in the capsules."""


@dataclass
class Capsule:
    """A capsule that tapers from radius r0 to r1, flattened by the factor `thin` along `flat`; it moves with `bone`.

    A draped capsule follows the nearest of the bones `drape` as well: by a share that grows from 0 at its start to
    `sag` at its end.
    """

    start: Array
    end: Array
    r0: float
    r1: float
    flat: Array
    thin: float
    bone: int
    color: Array
    rigid: bool
    drape: tuple[int, ...] = ()
    sag: float = 0.0

    def axial_coordinates(self, points: Array) -> tuple[Array, Array]:
        """Position along the axis (N,), 0 to 1, and approximate signed distance to the surface (N,)."""
        axis = self.end - self.start
        away = points - self.start
        away = away + (1 / self.thin - 1) * (away @ self.flat)[:, None] * self.flat
        t = (away @ axis / max(axis @ axis, 1e-12)).clip(0, 1)
        radius = self.r0 + (self.r1 - self.r0) * t
        return t, np.linalg.norm(away - t[:, None] * axis, axis=1) - radius

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """`count` points on the surface, about evenly distributed."""
        axis = self.end - self.start
        length = max(float(np.linalg.norm(axis)), 1e-9)
        axis = axis / length
        side = np.cross(axis, [0.3, 0.5, 0.81])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        along = rng.uniform(-self.r0, length + self.r1, count)
        t = along.clip(0, length)
        radius = self.r0 + (self.r1 - self.r0) * t / length
        around = np.sqrt(np.maximum(radius**2 - (along - t) ** 2, 0))
        angle = rng.uniform(0, 2 * np.pi, count)
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
        points = along[:, None] * axis + around[:, None] * ring
        return self.start + points + (self.thin - 1) * (points @ self.flat)[:, None] * self.flat

    @property
    def area(self) -> float:
        return float((self.r0 + self.r1) * (np.linalg.norm(self.end - self.start) + self.r0 + self.r1))


@dataclass
class RigBuilder:
    """Bones and capsules of a synthetic rig, added one by one."""

    rng: np.random.Generator
    parents: list[int] = field(default_factory=list)
    heads: list[Array] = field(default_factory=list)
    tails: list[Array] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    capsules: list[Capsule] = field(default_factory=list)

    def add_bone(self, parent: int, head: Array, tail: Array, name: str = "") -> int:
        self.parents.append(parent)
        self.heads.append(np.asarray(head, float))
        self.tails.append(np.asarray(tail, float))
        self.names.append(name)
        return len(self.parents) - 1

    def add_root(self, chance: float) -> int:
        """With this chance add a root bone on the ground without capsules; returns it, or -1 for no bone."""
        if self.rng.random() >= chance:
            return -1
        return self.add_bone(-1, np.zeros(3), np.array([0.0, 0.0, 0.2]), "Root")

    def add_capsule(
        self, bone: int, r0: float, r1: float, color: Array, *, flat: Array | None = None, thin: float = 1.0,
        segment: tuple[Array, Array] | None = None, rigid: bool = False, drape: tuple[int, ...] = (), sag: float = 0.0,
    ) -> None:  # fmt: skip
        start, end = segment or (self.heads[bone], self.tails[bone])
        axis = np.array([1.0, 0, 0]) if flat is None else flat / np.linalg.norm(flat)
        self.capsules.append(Capsule(start, end, r0, r1, axis, thin, bone, color, rigid, drape, sag))

    def add_chain(
        self, parent: int, start: Array, direction: Array, lengths: Array, radius: float, taper: float, color: Array,
        *, bend: float = 0.3, flat: Array | None = None, thin: float = 1.0, names: Sequence[str] = ("",),
    ) -> list[int]:  # fmt: skip
        """Add bones in a row, each turned a little against the previous one; returns them. The last name is used
        for all further bones."""
        made: list[int] = []
        at, way = np.asarray(start, float), np.asarray(direction, float)
        for number, length in enumerate(lengths):
            way = way / np.linalg.norm(way)
            parent = self.add_bone(parent, at, at + way * length, names[min(number, len(names) - 1)])
            self.add_capsule(parent, radius, radius * taper, color, flat=flat, thin=thin)
            made.append(parent)
            at, radius = at + way * length, radius * taper
            way = way + self.rng.normal(0, bend, 3)
        return made

    def _mirror(self, bones: int, capsules: int) -> None:
        """Mirror to the other side all bones and capsules from the numbers `bones` and `capsules` on."""
        count = len(self.parents) - bones
        for bone in range(bones, bones + count):
            parent = self.parents[bone] + (count if self.parents[bone] >= bones else 0)
            self.add_bone(parent, self.heads[bone] * MIRROR, self.tails[bone] * MIRROR, self.names[bone])
        for part in self.capsules[capsules:]:
            bone = part.bone + count if part.bone >= bones else part.bone
            mirrored = {"start": part.start * MIRROR, "end": part.end * MIRROR, "flat": part.flat * MIRROR}
            self.capsules.append(replace(part, bone=bone, **mirrored))

    def add_mirrored(self, grow: Callable[[], None]) -> None:
        """Add what `grow` adds at x > 0, and its mirror image."""
        bones, capsules = len(self.parents), len(self.capsules)
        grow()
        self._mirror(bones, capsules)


def cover_with_splats(rig: RigBuilder, skeleton: Skeleton, count: int) -> tuple[Array, Array, Array]:
    """`count` points (N, 3) on the outside of all capsules, their colours (N, 3) and weights (N, B).

    Weights blend between the capsule's bone and its neighbours in the tree, by how deep the point lies in the capsules
    of each or by the distance to each bone; rigid capsules follow their bone alone; see `Capsule` for draped ones.
    """
    rng = rig.rng
    area = np.array([part.area for part in rig.capsules])
    weight_rule = _WeightRule(rig, skeleton, rng)
    points, colors, weights = [], [], []
    for number, part in enumerate(rig.capsules):
        some = part.sample(max(int(1.5 * count * area[number] / area.sum()), 8), rng)
        buried = np.zeros(len(some), bool)
        for other in rig.capsules:
            if other is not part:
                buried |= other.axial_coordinates(some)[1] < -0.1 * min(other.r0, other.r1) * other.thin
        some = some[~buried]
        points.append(some)
        colors.append(np.tile(part.color, (len(some), 1)))
        weights.append(weight_rule(part, some))
    every = np.concatenate(points), np.concatenate(colors), np.concatenate(weights)
    picked = rng.permutation(len(every[0]))[:count]
    return every[0][picked], every[1][picked], every[2][picked]


class _WeightRule:
    """How the weights of a creature blend between its bones."""

    def __init__(self, rig: RigBuilder, skeleton: Skeleton, rng: np.random.Generator) -> None:
        self._skeleton = skeleton
        self._soft = rng.uniform(0.08, 0.5)
        self._power = rng.uniform(3.0, 8.0)
        self._by_nearness = rng.random() < BLEND_BY_DISTANCE
        self._by_bone: dict[int, list[Capsule]] = {}
        for part in rig.capsules:
            if not part.rigid:
                self._by_bone.setdefault(part.bone, []).append(part)

    def __call__(self, part: Capsule, points: Array) -> Array:
        """Weights (N, B) of points on a capsule, rows sum to 1."""
        own = np.zeros((len(points), self._skeleton.count))
        if part.drape:
            share = part.sag * part.axial_coordinates(points)[0]
            legs = self._nearness(points, np.array(part.drape), 4.0)
            own[:, part.drape] = share[:, None] * legs / legs.sum(axis=1, keepdims=True)
            own[:, part.bone] += 1 - share
        elif part.rigid:
            own[:, part.bone] = 1
        else:
            kin = [part.bone, int(self._skeleton.parents[part.bone]), *self._skeleton.children(part.bone)]
            kin = [int(bone) for bone in kin if int(bone) in self._by_bone]
            if self._by_nearness:
                own[:, kin] = self._nearness(points, np.array(kin), self._power)
            else:
                for bone in kin:
                    for capsule in self._by_bone[bone]:
                        depth = capsule.axial_coordinates(points)[1] / (self._soft * (part.r0 + part.r1))
                        own[:, bone] = np.maximum(own[:, bone], np.exp(-depth.clip(-20, 20) * 2))
        out: Array = own / np.maximum(own.sum(axis=1, keepdims=True), 1e-30)
        return out

    def _nearness(self, points: Array, bones: Array, power: float) -> Array:
        """(N, len(bones)): a power of nearest distance / distance of each bone, 1 for the nearest."""
        start = self._skeleton.heads[bones]
        axis = self._skeleton.tails[bones] - start
        away = points[:, None] - start
        t = ((away * axis).sum(-1) / np.maximum((axis * axis).sum(-1), 1e-12)).clip(0, 1)
        way = np.linalg.norm(away - t[..., None] * axis, axis=-1) + 1e-3
        out: Array = (way.min(axis=1, keepdims=True) / way) ** power
        return out
