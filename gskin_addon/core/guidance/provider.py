# SPDX-License-Identifier: GPL-3.0-or-later
"""What a guidance provider is given and what it gives."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..rig.skeleton import Skeleton
from ..splats.cloud import SplatCloud
from .control import ControlSignal


def never_stop(done: float, message: str) -> None:
    """A `tick` that does nothing."""


@dataclass(frozen=True)
class GuidanceContext:
    """One object, in unit size.

    cloud, skeleton: in the same space; initial (N, B): the weights that learning starts from;
    distances (N, B): from splats to bones through the body; index (N,): which of the job's splats these are,
    all of them in their order when left out; whole: how many splats the job has; options: the provider's own
    settings; seed: of all its randomness; checkpoint: a folder where it may keep what it has made, none by default;
    tick: called now and then with the finished part (0 to 1) of all images and a short message; raises Cancelled when
    the user stops the job.
    """

    cloud: SplatCloud
    skeleton: Skeleton
    initial: NDArray[np.float32]
    distances: NDArray[np.float32]
    index: NDArray[np.int64] | None = None
    whole: int | None = None
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    options: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    checkpoint: Path | None = None
    tick: Callable[[float, str], None] = never_stop


class Provider(Protocol):
    """Turns control signals into guidance images.

    A module offers it as `create(context) -> Provider`, which raises InputError when something is missing. It may
    have `facts`, a table of plain values that go into the job's report; see `facts_of`.
    """

    def images(self, signals: Sequence[ControlSignal]) -> Iterator[NDArray[np.uint8]]:
        """One image (H, W, 3) uint8 sRGB per signal, in order, made as it is asked for."""


def facts_of(provider: Provider) -> dict[str, Any]:
    """What a provider says about the images that it made; empty for one that says nothing."""
    return dict(getattr(provider, "facts", {}))


def to_bytes(image: NDArray[Any]) -> NDArray[np.uint8]:
    """An image in [0, 1] as uint8: 200 guidance images in float32 would be 630 MB."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
