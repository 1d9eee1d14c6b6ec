# SPDX-License-Identifier: GPL-3.0-or-later
"""What a score depends on besides asset and method, and its short name in the cache."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

from benchmarks.metrics import POSES

VERSION = 1
"""Raise it when the judge measures something else, so that old results are not taken for new ones."""


@dataclass(frozen=True)
class Protocol:
    """The paper's Sec. IV-C: splats of an asset, frames of its animation, views of each, pixels across.

    picture_frames: of the frames, how many are rendered (evenly spread); positions are compared in all of them.
    poses: random poses for the second position error; unused_bones: keep bones without any weight.
    """

    splats: int = 20_000
    seed: int = 0
    frames: int = 24
    picture_frames: int = 12
    views: int = 6
    size: int = 512
    poses: int = POSES
    unused_bones: bool = False

    @property
    def key(self) -> str:
        """Ten hexadecimal digits that stand for these values."""
        text = json.dumps([VERSION, asdict(self)], sort_keys=True)
        return hashlib.sha1(text.encode()).hexdigest()[:10]

    def describe(self) -> str:
        """The values in words, for the head of a table."""
        pictures = min(self.picture_frames, self.frames)
        kept = ", bones without weights kept" if self.unused_bones else ""
        return (
            f"{self.splats:,} splats, {self.frames} frames, of which {pictures} x {self.views} views are rendered at "
            f"{self.size} px, {self.poses} random poses{kept}"
        )
