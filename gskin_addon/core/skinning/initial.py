# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial skinning weights from geometry (Eq. 6-7) or learned, and their registry by name.

Imports numpy only, so that a user interface can list the names; the kernels are loaded when weights are computed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rig.influences import Influences
from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from ..ticks import Tick, silent, stretch
from .extent import unit_frame

if TYPE_CHECKING:
    from ..render.camera import Camera

Array = NDArray[Any]
InitialWeights = Callable[
    [SplatCloud, Skeleton, Array | None, "Sequence[Camera]", Mapping[str, Any], "Array | None", Tick],
    tuple[Array, "Array | None"],
]

GAMMA = 0.5
"""Binding smoothness of Eq. 7, the paper's default."""

DELTA = 0.1
"""The invisibility penalty of Eq. 6 for an object of unit diagonal: 10 % of it, the paper's value."""

GEODESIC_SHARPNESS = 2.0
"""Power on Eq. 7 for geodesic distances, which separate body parts well enough for a sharper falloff.

On 12 rigged assets it lowers the posed-position error against the artist's weights by 5 to 70 %; 2 and 3 are
equally good.
"""

_CLOSEST = 1e-8  # squared: the distance of a splat on a bone counts as 1e-4 of the diagonal


def falloff_weights(squared: Array, gamma: float = GAMMA, sharpness: float = 1.0) -> Array:
    """Eq. 7: w = (1 / ((1 - gamma) D + gamma D^2))^2, raised to `sharpness` (1 in the paper), rows sum to 1.

    squared (N, B): D, squared distances of an object with unit diagonal, infinite where a bone has no
    influence. Returns float32. A row of infinities gets equal weights.
    """
    d = np.maximum(np.asarray(squared, dtype=np.float64), _CLOSEST)
    cost = (1 - gamma) * d + gamma * d * d
    nearest = cost.min(axis=1, keepdims=True)
    lost = ~np.isfinite(nearest[:, 0])
    if lost.any():
        cost[lost], nearest[lost] = 1, 1
    weights = (nearest / cost) ** (2 * sharpness)  # relative to the nearest bone: no overflow
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def initial_weights_visibility(
    means: Array,
    skeleton: Skeleton,
    masks: Array,
    cameras: Sequence[Camera],
    gamma: float = GAMMA,
    delta: float = DELTA,
    *,
    tick: Tick = silent,
) -> Array:
    """The paper's initial weights: by Euclidean distance to the bones, plus `delta` for bones that are not visible.

    A bone is what lies between joints (Eq. 6: between a joint and its parent), not a tail that an importer made up:
    see `bone_segments`. Where several joints hang on a bone, the ways to them are bones of their own in the paper; here
    they turn together, so their weights add up (Eq. 1).
    The object is first scaled to unit bounding-box diagonal (D mixes squared lengths with a length), so that the result
    does not depend on scale or position. means (N, 3) metres; masks (V, H, W) bool of the object in each camera (Eq.
    6), such as a rendered alpha above 0.5; pinholes in them count as outside. Returns (N, B) float32, rows sum to 1.
    """
    from ..rig.segments import bone_segments
    from .visibility import bone_visibility

    _, diagonal = unit_frame(means)
    segments = bone_segments(skeleton)
    squared, visible = bone_visibility(means, segments.skeleton(), masks, cameras, tick=tick)
    weights = falloff_weights(squared / diagonal**2 + np.where(visible, 0, delta), gamma)
    return segments.add_up(weights)


def initial_weights_geodesic(
    means: Array,
    opacities: Array,
    skeleton: Skeleton,
    gamma: float = GAMMA,
    *,
    sharpness: float = GEODESIC_SHARPNESS,
    resolution: int = 96,
    scales: Array | None = None,
    quats: Array | None = None,
    walls: Array | None = None,
    tick: Tick = silent,
) -> Array:
    """Eq. 7 on geodesic distances through the filled splats (Dionne & de Lasa 2013) to what the bones span;
    see `geodesic_distances`, which takes the walls (N,), and `bone_segments`.

    Returns (N, B) float32, rows sum to 1.
    """
    from ..rig.segments import bone_segments
    from .geodesic import geodesic_distances

    _, diagonal = unit_frame(means)
    segments = bone_segments(skeleton)
    distance = segments.nearest(
        geodesic_distances(
            means, opacities, segments.skeleton(), resolution, scales=scales, quats=quats, walls=walls,
            tick=stretch(tick, 0.0, 0.9),
        )
    )  # fmt: skip
    return falloff_weights(np.square(distance / diagonal), gamma, sharpness)


def _visibility(
    cloud: SplatCloud, skeleton: Skeleton, masks: Array | None, cameras: Sequence[Camera], options: Mapping[str, Any],
    walls: Array | None, tick: Tick,
) -> tuple[Array, None]:  # fmt: skip
    if masks is None:
        raise ValueError("visibility looks at masks; see `needs_masks`")
    return initial_weights_visibility(cloud.means, skeleton, masks, cameras, tick=tick), None


def _geodesic(
    cloud: SplatCloud, skeleton: Skeleton, masks: Array | None, cameras: Sequence[Camera], options: Mapping[str, Any],
    walls: Array | None, tick: Tick,
) -> tuple[Array, None]:  # fmt: skip
    weights = initial_weights_geodesic(
        cloud.means, cloud.opacities, skeleton, scales=cloud.scales, quats=cloud.quats, walls=walls, tick=tick
    )
    return weights, None


def _heat(
    cloud: SplatCloud, skeleton: Skeleton, masks: Array | None, cameras: Sequence[Camera], options: Mapping[str, Any],
    walls: Array | None, tick: Tick,
) -> tuple[Array, None]:  # fmt: skip
    from .learned.predict import heat_weights

    return heat_weights(cloud, skeleton, walls=walls, tick=tick), None


def _learned(
    cloud: SplatCloud, skeleton: Skeleton, masks: Array | None, cameras: Sequence[Camera], options: Mapping[str, Any],
    walls: Array | None, tick: Tick,
) -> tuple[Array, Array]:  # fmt: skip
    from .learned.predict import learned_weights

    model = options.get("model")
    return learned_weights(cloud, skeleton, Path(model) if model else None, walls=walls, tick=tick)


INITIAL_WEIGHTS: dict[str, InitialWeights] = {
    "learned": _learned,
    "visibility": _visibility,
    "geodesic": _geodesic,
    "heat": _heat,
}
"""By name: (cloud, skeleton, masks (V, H, W) bool, cameras, options, walls, tick) -> weights (N, B) float32 whose rows
sum to 1, and confidence (N,) in [0, 1] or None if the method has none."""

DEFAULT_INITIAL = "learned"

PRESENT = "present"
"""Not a method: the current weights of the splats, which are part of the job (`core/job/scope.py`)."""


def needs_masks(name: str) -> bool:
    """Whether the method `name` needs masks of the object."""
    return name == "visibility"


OPTIONS: dict[str, tuple[str, ...]] = {"learned": ("model",)}
"""By name, the options that a method knows. `model`: a file made by `gskin train-prior`."""


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """InputError unless the method `name` knows the options and their values can be used."""
    known = OPTIONS.get(name, ())
    for key, value in options.items():
        if key not in known:
            takes = f"it takes {', '.join(known)}" if known else "it takes none"
            raise InputError(f"The initial weights '{name}' have no option '{key}'; {takes}.")
        if not isinstance(value, str):
            raise InputError(f"The option '{key}' of the initial weights is {value!r}; it must be a path.")
        if value and not os.path.isfile(value):  # Path's own raises for names that no system has
            raise InputError(f"The model '{value}' does not exist; name a file made by gskin train-prior.")


def initial_weights(
    name: str,
    cloud: SplatCloud,
    skeleton: Skeleton,
    masks: Array,
    cameras: Sequence[Camera],
    options: Mapping[str, Any] | None = None,
) -> Array:
    """Weights (N, B) by the method called `name`; InputError lists the names when there is none."""
    return initial_with_confidence(name, cloud, skeleton, masks, cameras, options)[0]


def initial_with_confidence(
    name: str,
    cloud: SplatCloud,
    skeleton: Skeleton,
    masks: Array | None,
    cameras: Sequence[Camera],
    options: Mapping[str, Any] | None = None,
    *,
    walls: Array | None = None,
    tick: Tick = silent,
) -> tuple[Array, Array | None]:
    """As `initial_weights`, with the confidence (N,) in [0, 1] of each splat's weights where the method has one.

    walls (N,): labels of the splats, 0 for none, see `walls`; "visibility" ignores them. tick: called with the
    progress, 0 to 1, a few times a second; an exception from it stops the work.
    """
    if name not in INITIAL_WEIGHTS:
        raise InputError(f"No initial weights are called '{name}'; choose {' or '.join(INITIAL_WEIGHTS)}.")
    return INITIAL_WEIGHTS[name](cloud, skeleton, masks, cameras, options or {}, walls, tick)


def initial_with_start(
    name: str,
    cloud: SplatCloud,
    skeleton: Skeleton,
    masks: Array | None,
    cameras: Sequence[Camera],
    options: Mapping[str, Any] | None = None,
    *,
    walls: Array | None = None,
    tick: Tick = silent,
) -> tuple[Array, Array | None, Influences | None]:
    """As `initial_with_confidence`, and what a method that has learned started from: for "learned" its bone heat."""
    if name != "learned":
        given = cloud, skeleton, masks, cameras, options
        return *initial_with_confidence(name, *given, walls=walls, tick=tick), None
    from .learned.predict import learned_weights_and_heat

    model = (options or {}).get("model")
    return learned_weights_and_heat(cloud, skeleton, Path(model) if model else None, walls=walls, tick=tick)
