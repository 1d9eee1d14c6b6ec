# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit a skeleton to splats: a person's or a quadruped's joints by votes, bones between them, both sides alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_arrays
from ..rig.quaternion import axis_angle_to_matrix, matrix_to_quat, quat_multiply
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from ..ticks import Tick, silent
from . import ends, layouts
from .bird import bird_front, bird_joints
from .body_shape import body_shape
from .joints import HUMAN, MIDDLE, QUADRUPED
from .landmarks import ends_at, move_to_landmarks, on_their_sides
from .stance import QUARTER, Standing, feet_ahead, quarter_turns, slant, stand
from .votes import VoteNetwork, features, mirrored

Array = NDArray[Any]

LOOKS = {"-y": 0, "+x": 3, "+y": 2, "-x": 1}
"""To where a body may look, and by how many quarters it must be turned about z to look along -y."""

ALIKE = 0.05
"""Sides count as alike where a joint lies within this share of the diagonal of its twin's mirror image, in the mean."""

UNSURE = 0.055
"""A fit is unsure where the votes for its joints lie farther apart than this share of the diagonal, in the mean."""

FEET = 0.03
"""Where that is not clear for a person, feet decide that reach so much farther, in heights, behind the shins."""

CLEAR = 5.0
"""It is clear to where a body looks where the best of four turns is ahead of the next by so much, in logits."""

ASIDE = 0.02
"""Landmarks of a side say to where a body looks where they lie so far from its middle, a share of the diagonal."""


@dataclass(frozen=True)
class Kind:
    """A kind of body: names of its joints, its unit of length, its bones, and how its ends are told."""

    joints: tuple[str, ...]
    unit: str
    bones: tuple[layouts.Bone, ...]
    ends: Any


KINDS = {
    "human": Kind(HUMAN, "height", layouts.HUMAN, ends.human_ends),
    "quadruped": Kind(QUADRUPED, "diagonal", layouts.QUADRUPED, ends.quadruped_ends),
    "bird": Kind((), "diagonal", layouts.BIRD, None),
}


@dataclass(frozen=True)
class Fit:
    """skeleton: bones in the body's own frame, in metres: it stands on z = 0, looks along -y, its left is +x; deform
    (B,): bones that splats may follow; placement (4, 4): from that frame to the splats'; joints: by name, in that
    frame; alike: whether both sides were made mirror images; doubt: how far the votes for the joints lie
    apart, a share of the diagonal; front_sure: whether it is clear to where the body looks."""

    kind: str
    skeleton: Skeleton
    deform: Array
    placement: Array
    joints: dict[str, Array]
    alike: bool
    doubt: float
    front_sure: bool = True

    @property
    def unsure(self) -> bool:
        """Whether somebody should look, or name landmarks."""
        return self.doubt > UNSURE or not self.front_sure

    def placed(self) -> Skeleton:
        """The deform bones among the splats."""
        own = self.skeleton.subset(self.deform)
        return own.moved(self.placement[:3, :3], 1.0, self.placement[:3, 3])


def fit(
    kind: str,
    cloud: SplatCloud,
    *,
    front: str = "auto",
    alike: bool | None = None,
    landmarks: Mapping[str, Array] | None = None,
    tick: Tick = silent,
) -> Fit:
    """Fit a skeleton of a kind of `KINDS` to splats that stand with z up.

    front: a key of `LOOKS`, or "auto". alike: make both sides mirror images; None: where they nearly are.
    landmarks: points (3,) among the splats by the names of `landmarks.NAMES`, to which the fit is brought; those of a
    side also say to where the body looks, unless `front` does.

    Raises:
        InputError: too few splats, or an unknown landmark.
    """
    if kind not in KINDS:
        raise InputError(f"'{kind}' is no kind of skeleton; choose one of {', '.join(KINDS)}.")
    if kind == "bird":
        return _fit_bird(cloud, front, alike, landmarks, tick)
    return fit_with(kind, _network(kind), cloud, front=front, alike=alike, landmarks=landmarks, tick=tick)


def fit_with(
    kind: str,
    network: VoteNetwork,
    cloud: SplatCloud,
    *,
    front: str = "auto",
    alike: bool | None = None,
    landmarks: Mapping[str, Array] | None = None,
    tick: Tick = silent,
) -> Fit:
    """`fit` by another network than the one that comes with the add-on."""
    _check_front(front)
    spec = KINDS[kind]
    standing, turn, clear = _turned(cloud, spec, network, front, landmarks or {}, tick)
    values = features(standing.shape, standing.scale)
    left, right = network(values), network(mirrored(values))
    tick(0.8)
    flip = np.array([-1.0, 1.0, 1.0])
    found = _named(spec.joints, left.joints * standing.scale, right.joints * flip * standing.scale)
    spread = float(np.concatenate([left.spread, right.spread]).mean()) * standing.scale / standing.diagonal
    found, shift, same, goals = _finished(found, standing, turn, alike, landmarks or {})
    surface = standing.shape.points - shift
    skeleton, deform = layouts.build(spec.bones, ends_at(spec.ends(found, surface), goals))
    placement = np.eye(4)
    placement[:3, :3] = turn
    placement[:3, 3] = turn @ (standing.origin + shift)
    tick(1.0)
    return Fit(kind, skeleton, deform, placement, found, same, spread, clear)


def _fit_bird(
    cloud: SplatCloud, front: str, alike: bool | None, landmarks: Mapping[str, Array] | None, tick: Tick
) -> Fit:
    """A bird by its outline; always for somebody to look at."""
    _check_front(front)
    shape = body_shape(cloud)
    tick(0.5)
    base = np.eye(3)
    if front == "auto":
        base = _about_z(slant(shape.points))
        if not np.array_equal(base, np.eye(3)):
            shape = body_shape(_turned_places(cloud, base))
    standings = [stand(turned, KINDS["bird"].unit) for turned in quarter_turns(shape)]
    if front != "auto":
        quarters = LOOKS[front]
    else:
        quarters = bird_front([turned.shape.points for turned in standings])
        allowed = _allowed(standings, base, landmarks or {})
        quarters = next(turned % 4 for turned in (quarters, quarters + 2, *allowed) if turned % 4 in allowed)
    standing, turn = standings[quarters], _turn_back(quarters, base)
    found = bird_joints(standing.shape.points)
    found, shift, same, goals = _finished(found, standing, turn, alike, landmarks or {})
    skeleton, deform = layouts.build(layouts.BIRD, ends_at(found, goals))
    placement = np.eye(4)
    placement[:3, :3], placement[:3, 3] = turn, turn @ (standing.origin + shift)
    tick(1.0)
    return Fit("bird", skeleton, deform, placement, found, same, 2 * UNSURE)


def both_alike(joints: dict[str, Array], diagonal: float, wanted: bool | None) -> tuple[dict[str, Array], Array, bool]:
    """Joints whose plane between the sides is x = 0, by how much (3,) they were moved for it, and whether they are now
    mirror images: as `wanted`, or None for where they nearly are."""
    pairs = [name[:-2] for name in joints if name.endswith(".L")]
    middle = [joints[name][0] for name in joints if name in MIDDLE]
    middle += [(joints[f"{name}.L"][0] + joints[f"{name}.R"][0]) / 2 for name in pairs]
    shift = np.array([float(np.median(middle)), 0.0, 0.0])
    own = {name: place - shift for name, place in joints.items()}
    flip = np.array([-1.0, 1.0, 1.0])
    off = [float(np.linalg.norm(own[f"{name}.L"] - flip * own[f"{name}.R"])) for name in pairs]
    if not (float(np.mean(off)) < ALIKE * diagonal if wanted is None else wanted):
        return own, shift, False
    for name in pairs:
        own[f"{name}.L"] = (own[f"{name}.L"] + flip * own[f"{name}.R"]) / 2
        own[f"{name}.R"] = flip * own[f"{name}.L"]
    for name in MIDDLE:
        if name in own:
            own[name] = own[name] * np.array([0.0, 1.0, 1.0])
    return own, shift, True


def _finished(
    found: dict[str, Array], standing: Standing, turn: Array, alike: bool | None, landmarks: Mapping[str, Array]
) -> tuple[dict[str, Array], Array, bool, dict[str, Array]]:
    """As `both_alike`, with the limbs brought to landmarks, and these in the joints' frame. Where both sides are alike,
    a landmark of one side holds for the other as well; two that contradict one another leave each side as it is."""
    diagonal = standing.diagonal
    own, shift, same = both_alike(found, diagonal, alike)
    goals: dict[str, Array] = {}
    if not landmarks:
        return own, shift, same, goals
    flip = np.array([-1.0, 1.0, 1.0])
    for name, at in landmarks.items():
        goals[name] = turn.T @ np.asarray(at, np.float64) - standing.origin
    twins = {name: name[:-1] + "LR"[name[-1] == "L"] for name in goals if name[-2:] in (".L", ".R")}
    off = [np.linalg.norm(goals[name] - shift - flip * (goals[twin] - shift))
           for name, twin in twins.items() if twin in goals]  # fmt: skip
    if same and alike is None and max(off, default=0.0) > ALIKE * diagonal:
        own, shift, same = both_alike(found, diagonal, False)
    goals = {name: goal - shift for name, goal in goals.items()}
    if same:
        goals |= {twin: flip * goals[name] for name, twin in twins.items() if twin not in goals}
    own = move_to_landmarks(own, goals, standing.shape.points - shift)
    if same:
        own, further, _ = both_alike(own, diagonal, True)
        shift = shift + further
        goals = {name: goal - further for name, goal in goals.items()}
    return own, shift, same, goals


def _turned(
    cloud: SplatCloud, spec: Kind, network: VoteNetwork, front: str, landmarks: Mapping[str, Array], tick: Tick
) -> tuple[Standing, Array, bool]:
    """The body looking along -y, the rotation (3, 3) from there to how the splats lie, and whether that is clear."""
    shape = body_shape(cloud)
    tick(0.4)
    if front != "auto":
        quarters = LOOKS[front]
        turned = quarter_turns(shape)[quarters]
        return stand(turned, spec.unit), _turn_back(quarters, np.eye(3)), True
    angle = slant(shape.points)
    base = _about_z(angle)
    if angle:
        shape = body_shape(_turned_places(cloud, base))
    tick(0.7)
    standings = [stand(turned, spec.unit) for turned in quarter_turns(shape)]
    allowed = _allowed(standings, base, landmarks)
    looks = [_fits(network, turned) if number in allowed else -np.inf for number, turned in enumerate(standings)]
    best = int(np.argmax(looks))
    clear = looks[best] - sorted(looks)[-2] > CLEAR
    opposite = (best + 2) % 4
    if not clear and looks[opposite] == sorted(looks)[-2] and spec.unit == "height":
        best = opposite if feet_ahead(standings[best]) < -FEET else best
    return standings[best], _turn_back(best, base), bool(clear)


def _allowed(standings: list[Standing], base: Array, landmarks: Mapping[str, Array]) -> list[int]:
    """Which of four turns landmarks of a side allow: what somebody has marked as a left hand lies on the left. All
    where nothing is marked that tells."""
    met = []
    for number, standing in enumerate(standings):
        back = _turn_back(number, base)
        places = {name: back.T @ np.asarray(at, np.float64) - standing.origin for name, at in landmarks.items()}
        met.append(on_their_sides(places))
    if max(met) < ASIDE * standings[0].diagonal:
        return list(range(len(standings)))
    return [number for number, far in enumerate(met) if far >= max(met) / 2]


def _turn_back(quarters: int, base: Array) -> Array:
    """The rotation (3, 3) from a body that was turned by `base`, then by quarters about z, to how it lay."""
    return np.asarray((np.linalg.matrix_power(QUARTER, quarters) @ base).T)


def _check_front(front: str) -> None:
    if front != "auto" and front not in LOOKS:
        raise InputError(f"'{front}' is no direction to look to; choose auto, {', '.join(LOOKS)}.")


def _about_z(angle: float) -> Array:
    return np.asarray(axis_angle_to_matrix(np.array([0.0, 0.0, 1.0]), np.array(angle)))


def _turned_places(cloud: SplatCloud, turn: Array) -> SplatCloud:
    """The splats after a turn, but for their colours."""
    quat = matrix_to_quat(turn).astype(cloud.quats.dtype)
    quats = quat_multiply(np.broadcast_to(quat, cloud.quats.shape), cloud.quats)
    return replace(cloud, means=cloud.means @ turn.T, quats=quats)


def _fits(network: VoteNetwork, standing: Standing) -> float:
    values = features(standing.shape, standing.scale)
    return network(values).fits + network(mirrored(values)).fits


def _named(names: tuple[str, ...], left: Array, right: Array) -> dict[str, Array]:
    found = {}
    for number, name in enumerate(names):
        if name in MIDDLE:
            found[name] = (left[number] + right[number]) / 2
        else:
            found[f"{name}.L"], found[f"{name}.R"] = left[number], right[number]
    return found


@cache
def _network(kind: str) -> VoteNetwork:
    return VoteNetwork(read_arrays(Path(__file__).with_name(f"joints_{kind}.npz")))
