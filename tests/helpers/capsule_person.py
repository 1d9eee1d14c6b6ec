# SPDX-License-Identifier: GPL-3.0-or-later
"""A person of capsules whose joints are known, as splats."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.splats.cloud import SplatCloud

JOINTS = {
    "hips": (0, 0, 0.95), "neck": (0, 0.01, 1.48), "head": (0, 0, 1.58),
    "shoulder.L": (0.19, 0.01, 1.43), "elbow.L": (0.36, 0.02, 1.2), "wrist.L": (0.5, -0.03, 0.98),
    "thigh.L": (0.1, 0, 0.92), "knee.L": (0.13, -0.02, 0.5), "ankle.L": (0.15, 0.03, 0.08), "toe.L": (0.17, -0.1, 0.03),
}  # fmt: skip
"""Metres; it looks along -y, and its right side is the mirror image."""

_PARTS = (
    ("hips", "neck", 0.13, 0.12), ("neck", "head", 0.06, 0.06), ("head", (0, -0.01, 1.73), 0.09, 0.1),
    ("shoulder.*", "elbow.*", 0.055, 0.045), ("elbow.*", "wrist.*", 0.045, 0.035),
    ("wrist.*", (0.56, -0.08, 0.85), 0.04, 0.03), ("neck", "shoulder.*", 0.07, 0.07), ("hips", "thigh.*", 0.11, 0.1),
    ("thigh.*", "knee.*", 0.09, 0.06), ("knee.*", "ankle.*", 0.06, 0.04), ("ankle.*", (0.18, -0.17, 0.03), 0.05, 0.03),
)  # fmt: skip


def joints() -> dict[str, np.ndarray]:
    """All joints, both sides."""
    out = {}
    for name, place in JOINTS.items():
        out[name] = np.array(place, float)
        if name.endswith(".L"):
            out[f"{name[:-1]}R"] = out[name] * [-1, 1, 1]
    return out


def person(count: int = 8000, seed: int = 0) -> SplatCloud:
    """Splats on the person's skin."""
    rng = np.random.default_rng(seed)
    known, parts = joints(), []
    for side in "LR":
        for start, end, wide, narrow in _PARTS:
            if side == "R" and "*" not in f"{start}{end}":
                continue
            ends = []
            for at in (start, end):
                place = known[at.replace("*", side)] if isinstance(at, str) else np.array(at, float)
                ends.append(place * [-1, 1, 1] if side == "R" and not isinstance(at, str) else place)
            parts.append((*ends, wide, narrow))
    area = np.array([(np.linalg.norm(b - a) + r0 + r1) * (r0 + r1) for a, b, r0, r1 in parts])
    points = []
    for (a, b, r0, r1), share in zip(parts, area / area.sum(), strict=True):
        n = int(share * count) + 1
        way = rng.normal(size=(n, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        along = rng.random((n, 1))
        points.append(a + along * (b - a) + way * (r0 + along * (r1 - r0)))
    means = np.concatenate(points)
    means[:, 2] = np.maximum(means[:, 2], 0.0)
    n = len(means)
    return SplatCloud(
        means.astype(np.float32), np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full((n, 3), 0.008, np.float32), np.full(n, 0.9, np.float32), np.zeros((n, 1, 3), np.float32),
    )  # fmt: skip
