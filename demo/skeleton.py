# SPDX-License-Identifier: GPL-3.0-or-later
"""The bones of the sample character and its poses. Metres, Z up, facing -Y; .L is at +X."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MIDDLE = {
    # name: (parent, head, tail)
    "hips": ("root", (0.0, 0.02, 0.60), (0.0, 0.015, 0.72)),
    "spine": ("hips", (0.0, 0.015, 0.72), (0.0, 0.02, 0.86)),
    "chest": ("spine", (0.0, 0.02, 0.86), (0.0, 0.02, 1.02)),
    "neck": ("chest", (0.0, 0.02, 1.02), (0.0, 0.0, 1.11)),
    "head": ("neck", (0.0, 0.0, 1.11), (0.0, -0.02, 1.50)),
    "tail.1": ("hips", (0.0, 0.10, 0.60), (0.0, 0.25, 0.48)),
    "tail.2": ("tail.1", (0.0, 0.25, 0.48), (0.0, 0.42, 0.41)),
    "tail.3": ("tail.2", (0.0, 0.42, 0.41), (0.0, 0.60, 0.43)),
    "tail.4": ("tail.3", (0.0, 0.60, 0.43), (0.0, 0.74, 0.54)),
    "tail.5": ("tail.4", (0.0, 0.74, 0.54), (0.0, 0.80, 0.74)),
    "cape.1": ("chest", (0.0, 0.15, 1.00), (0.0, 0.21, 0.86)),
    "cape.2": ("cape.1", (0.0, 0.21, 0.86), (0.0, 0.27, 0.72)),
    "cape.3": ("cape.2", (0.0, 0.27, 0.72), (0.0, 0.34, 0.58)),
}

_LEFT = {
    "ear": ("head", (0.165, 0.01, 1.33), (0.46, 0.07, 1.47)),
    "shoulder": ("chest", (0.03, 0.02, 0.98), (0.135, 0.03, 0.97)),
    "upper_arm": ("shoulder", (0.135, 0.03, 0.97), (0.335, 0.04, 0.84)),
    "forearm": ("upper_arm", (0.335, 0.04, 0.84), (0.515, 0.0, 0.71)),
    "hand": ("forearm", (0.515, 0.0, 0.71), (0.64, -0.02, 0.62)),
    "thigh": ("hips", (0.095, 0.02, 0.58), (0.125, -0.005, 0.34)),
    "shin": ("thigh", (0.125, -0.005, 0.34), (0.135, 0.03, 0.10)),
    "foot": ("shin", (0.135, 0.03, 0.10), (0.15, -0.14, 0.04)),
}


def bones() -> dict[str, tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """name -> (parent, head (3,), tail (3,)) of the 29 deform bones, parents first, below a bare `root`."""
    table = {name: (parent, np.array(head), np.array(tail)) for name, (parent, head, tail) in _MIDDLE.items()}
    for side, sign in ((".L", 1.0), (".R", -1.0)):
        for name, (parent, head, tail) in _LEFT.items():
            owner = parent if parent in _MIDDLE else parent + side
            flip = np.array([sign, 1.0, 1.0])
            table[name + side] = (owner, np.array(head) * flip, np.array(tail) * flip)
    return table


Turns = dict[str, tuple[float, float, float]]
"""bone -> rotation vector in degrees about the world's axes, in the parent's rest frame."""

POSES: dict[str, Turns] = {
    "wave": {
        "upper_arm.L": (0, -70, 10), "forearm.L": (0, -55, 0), "hand.L": (0, -15, 0),
        "upper_arm.R": (0, -22, 15), "forearm.R": (-25, 0, 25), "head": (0, 12, 8), "spine": (0, -5, 0),
        "ear.L": (0, -18, 0), "ear.R": (0, -12, 0), "tail.2": (0, 0, 20), "tail.3": (0, 0, 20),
        "tail.4": (0, 0, 20),
    },
    "stride": {
        "thigh.L": (-42, 0, 0), "shin.L": (30, 0, 0), "thigh.R": (28, 0, 0), "shin.R": (34, 0, 0),
        "foot.R": (15, 0, 0), "upper_arm.L": (30, 20, 0), "upper_arm.R": (-35, -20, 0),
        "forearm.R": (-40, 0, 0),
        "spine": (6, 0, -8), "chest": (0, 0, -10), "head": (-6, 0, 14), "cape.1": (14, 0, 0),
        "cape.2": (14, 0, 0), "cape.3": (10, 0, 0), "tail.1": (10, 0, 0), "tail.3": (-14, 0, -14),
    },
    "bow": {
        "spine": (22, 0, 0), "chest": (14, 0, 0), "neck": (4, 0, 0), "head": (-8, 0, 8),
        "upper_arm.L": (25, -40, 0), "upper_arm.R": (-20, 35, -10), "forearm.R": (-30, 30, -60),
        "thigh.L": (-14, 0, 0), "shin.L": (14, 0, 0), "ear.L": (0, 20, 0), "ear.R": (0, -20, 0),
        "tail.1": (-18, 0, 0), "tail.2": (-18, 0, 0), "cape.1": (-22, 0, 0),
    },
    "kick": {
        "hips": (0, 8, 0), "thigh.R": (-62, 12, 0), "shin.R": (18, 0, 0), "foot.R": (-15, 0, 0),
        "thigh.L": (8, -8, 0), "upper_arm.L": (0, -45, 0), "upper_arm.R": (0, 45, 0),
        "forearm.L": (-40, 0, -20), "forearm.R": (-20, 0, 20),
        "head": (0, -10, -12), "ear.L": (0, -25, 0), "ear.R": (0, 25, 0), "spine": (-8, -6, 12),
        "tail.1": (-12, 0, -15), "tail.2": (0, 0, -20), "tail.3": (0, 0, -22), "cape.1": (12, 0, 6),
    },
}  # fmt: skip


def wave_at(phase: float) -> Turns:
    """The looping animation at `phase` in 0..1: steps on the spot while waving, tail and cape swing after."""
    s, c = np.sin(2 * np.pi * phase), np.cos(2 * np.pi * phase)
    s2 = np.sin(4 * np.pi * phase)
    turns: Turns = {
        "hips": (0, 3 * s, 5 * s), "spine": (2, -3 * s, -6 * s), "chest": (0, -2 * s, -5 * s),
        "head": (3 * s2, 6 * s, 8 * c), "upper_arm.L": (0, -55 + 6 * s, 8),
        "forearm.L": (0, -55 + 28 * s2, 0),
        "hand.L": (0, 16 * s2, 0), "upper_arm.R": (-24 * s, -18, 0), "forearm.R": (-22 - 12 * s, 0, 14),
        "thigh.L": (-30 * max(s, -0.5), 0, 0), "shin.L": (38 * max(s, 0), 0, 0),
        "thigh.R": (-30 * max(-s, -0.5), 0, 0), "shin.R": (38 * max(-s, 0), 0, 0),
        "foot.L": (-8 * max(s, 0), 0, 0), "foot.R": (-8 * max(-s, 0), 0, 0),
        "ear.L": (0, -10 + 12 * s2, 0), "ear.R": (0, 10 - 12 * s2, 0),
    }  # fmt: skip
    for i in range(1, 6):
        turns[f"tail.{i}"] = (4 * s2, 0, 16 * np.sin(2 * np.pi * (phase - 0.08 * i)))
    for i in range(1, 4):
        turns[f"cape.{i}"] = (
            5 + 5 * np.sin(4 * np.pi * (phase - 0.07 * i)),
            0,
            4 * np.sin(2 * np.pi * (phase - 0.1 * i)),
        )
    return turns
