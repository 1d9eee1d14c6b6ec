# SPDX-License-Identifier: GPL-3.0-or-later
"""Procedural colours of the sample character: sRGB in 0..1 from rest positions, part by part."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .parts import CAPE_LINE, EYE_CENTER, EYE_RADIUS, SKIRT_HEM, SKIRT_TOP

Array = NDArray[np.float64]


def _rgb(code: str) -> Array:
    return np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0


SKIN, SKIN_DARK, SKIN_LIGHT = _rgb("3fa796"), _rgb("1c5f66"), _rgb("8fd8b4")
CREAM, ROSE, INK = _rgb("f6e7c1"), _rgb("f08a7a"), _rgb("1d2030")
TUNIC, TUNIC_DARK, GOLD = _rgb("e9b44c"), _rgb("b9742b"), _rgb("ffd966")
CAPE, CAPE_DARK, LEATHER = _rgb("d1495b"), _rgb("7d2244"), _rgb("5b3a29")
IVORY, BONE, FLAME, EMBER = _rgb("f3e6cf"), _rgb("a8895f"), _rgb("f26b3a"), _rgb("b5293c")
AMBER, WHITE, PLUM = _rgb("f5a623"), _rgb("fdfbf5"), _rgb("473366")


def step(x: Array, low: float, high: float) -> Array:
    """Smoothstep from 0 at `low` to 1 at `high`."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(base: Array, over: Array, amount: Array) -> Array:
    """Colours (n, 3) with `over` laid on by `amount` (n,) in 0..1."""
    return base + (over - base) * np.clip(amount, 0, 1)[:, None]


def noise(points: Array, frequency: float, seed: int = 0) -> Array:
    """Smooth value noise in -1..1 at points (n, 3)."""
    table = np.random.default_rng(seed).uniform(-1, 1, 4096)
    scaled = points * frequency + 1000.0
    cell = np.floor(scaled).astype(np.int64)
    f = scaled - cell
    f = f * f * (3 - 2 * f)
    total = np.zeros(len(points))
    for corner in range(8):
        bit = np.array([corner >> k & 1 for k in range(3)])
        at = cell + bit
        value = table[(at[:, 0] * 73856093 ^ at[:, 1] * 19349663 ^ at[:, 2] * 83492791) % 4096]
        total += value * np.prod(np.where(bit, f, 1 - f), axis=1)
    return total


def spots(points: Array, frequency: float, seed: int) -> Array:
    """Blotches: 1 inside, 0 outside, (n,)."""
    return step(noise(points, frequency, seed) + 0.4 * noise(points, 2.3 * frequency, seed + 1), 0.28, 0.45)


def paint_body(p: Array) -> Array:
    """Skin with stripes and a pale muzzle, a patterned tunic, boots and gloves."""
    x, y, z = p.T
    side = np.abs(x)
    rgb = mix(np.broadcast_to(SKIN, p.shape).copy(), SKIN_LIGHT, 0.5 + 0.9 * noise(p, 9, 1))
    head = z > 1.10
    rgb = mix(rgb, SKIN_DARK, 0.8 * spots(p, 16, 3) * (y > -0.02) * head)
    # Tail and limb stripes run around the part, from arc length along the tail and distance from the middle.
    along = np.where(y > 0.1, y + 0.45 * np.maximum(z - 0.43, 0), 0)
    ring = np.sin(along * 2 * np.pi / 0.085 + 1.3 * noise(p, 14, 5))
    tail = (y > 0.13) & (z < 0.78) & (side < 0.15)
    rgb = mix(rgb, SKIN_DARK, step(ring, 0.15, 0.5) * tail)
    under = step(0.43 - 0.25 * (y - 0.6) ** 2 - z, -0.005, 0.02) * tail * (y < 0.66)
    rgb = mix(rgb, CREAM, 0.75 * under)
    spade = (y > 0.70) & (z > 0.66)
    rgb = np.where(spade[:, None], mix(np.broadcast_to(EMBER, p.shape), FLAME, step(z, 0.68, 0.84)), rgb)
    arm_ring = np.sin((side - 0.02 * y) * 2 * np.pi / 0.062 + noise(p, 16, 6))
    rgb = mix(rgb, SKIN_DARK, step(arm_ring, 0.35, 0.7) * (side > 0.25) * (side < 0.47) * (z < 1.05) * (z > 0.6))

    # Face: pale muzzle and cheeks, nose, mouth, blush, brows.
    front = y < -0.02
    muzzle = np.sqrt((x / 0.15) ** 2 + ((z - 1.215) / 0.075) ** 2)
    rgb = mix(rgb, CREAM, step(1.15 - muzzle, 0.0, 0.22) * front * head)
    ball = np.sqrt((side / 0.034) ** 2 + ((z - 1.262) / 0.024) ** 2)
    rgb = mix(rgb, INK, step(1.15 - ball, 0, 0.25) * (y < -0.19) * head)
    smile = np.abs(z - (1.190 + 3.2 * np.maximum(side - 0.01, 0) ** 2)) / 0.0065
    rgb = mix(rgb, CAPE_DARK, step(1.4 - smile, 0, 0.6) * (side < 0.105) * (y < -0.10) * head)
    blush = np.sqrt(((side - 0.135) / 0.032) ** 2 + ((z - 1.232) / 0.02) ** 2)
    rgb = mix(rgb, ROSE, 0.85 * step(1.2 - blush, 0, 0.5) * front * head)
    ring_eye = np.linalg.norm((np.abs(p * [1, 0, 1]) - EYE_CENTER * [1, 0, 1]) / [1.18, 1, 1.18], axis=1)
    rgb = mix(rgb, SKIN_DARK, 0.85 * step(EYE_RADIUS * 1.12 - ring_eye, 0, 0.012) * (y < -0.05) * head)
    # Ears: rosy inside, dark tips.
    ear = (side > 0.175) & (z > 1.25)
    line = 1.355 + 0.40 * (side - 0.2)
    inside = step(0.034 - 0.05 * (side - 0.2) - np.abs(z - line), 0, 0.02)
    rgb = mix(rgb, ROSE, 0.9 * inside * ear * (y < 0.045 + 0.06 * (side - 0.2)))
    rgb = mix(rgb, SKIN_DARK, step(side, 0.385, 0.42) * ear)

    # Tunic on the torso and short sleeves: woven stripes, a band of diamonds, a V at the neck.
    sleeve = side - 0.6 * (0.97 - z)
    torso = (z > 0.55) & (z < 1.09) & (sleeve < 0.155) & (y < 0.135)
    weave = 0.5 + 0.5 * np.sin(z * 2 * np.pi / 0.04) * (1 - step(side, 0.16, 0.17))
    cloth = mix(np.broadcast_to(TUNIC, p.shape), TUNIC_DARK, 0.30 * step(weave, 0.55, 0.9) + 0.18 * noise(p, 40, 8))
    turn = np.arctan2(x, -(y - 0.015))
    diamond = np.abs((turn / (2 * np.pi) * 20) % 1 - 0.5) * 2 + np.abs(z - 0.845) / 0.032
    cloth = mix(cloth, PLUM, step(1.05 - diamond, 0, 0.2))
    cloth = mix(cloth, PLUM, step(0.010 - np.abs(np.abs(z - 0.845) - 0.044), 0, 0.005))
    cloth = mix(cloth, PLUM, step(sleeve, 0.132, 0.138))
    rgb = np.where(torso[:, None], cloth, rgb)

    # Gloves without fingers and laced boots.
    wrist = side - 0.35 * (z - 0.70)
    glove = (wrist > 0.485) & (z < 0.80) & (z > 0.55) & (side < 0.595 - 0.25 * (z - 0.66))
    rgb = np.where(glove[:, None], mix(np.broadcast_to(LEATHER, p.shape), TUNIC_DARK, 0.5 + 0.5 * noise(p, 30, 9)), rgb)
    rgb = mix(rgb, GOLD, (step(0.008 - np.abs(wrist - 0.494), 0, 0.004)) * glove)
    boot = (z < 0.225) & (y < 0.2)
    boots = mix(np.broadcast_to(LEATHER, p.shape), INK, 0.35 + 0.5 * noise(p, 22, 10))
    boots = mix(boots, INK, step(0.024 - z, -0.004, 0.004))
    lace = np.abs(((z - 0.10) / 0.034) % 1 - 0.5) * 2
    boots = mix(
        boots,
        GOLD,
        step(lace, 0.72, 0.85) * (np.abs(side - 0.135) < 0.028) * (y < 0.0) * (z > 0.10) * (z < 0.2),
    )
    boots = mix(boots, CREAM, step(z, 0.196, 0.203))
    return np.where(boot[:, None], boots, rgb)


def paint_horns(p: Array) -> Array:
    """Ivory with growth rings, darker to the tip."""
    height = (p[:, 2] - 1.43) / 0.29
    ring = np.sin(height * 46 + 2.5 * p[:, 1] / 0.1)
    rgb = mix(np.broadcast_to(IVORY, p.shape), BONE, 0.65 * step(ring, 0.0, 0.6))
    return mix(rgb, PLUM, step(height, 0.62, 1.0))


def paint_eyes(p: Array) -> Array:
    """White, amber iris with rays, pupil and two highlights; the gaze goes slightly outwards."""
    sign = np.where(p[:, 0] > 0, 1.0, -1.0)
    d = (p - EYE_CENTER * np.stack([sign, np.ones_like(sign), np.ones_like(sign)], 1)) / EYE_RADIUS
    gaze = np.stack([0.22 * sign, np.full(len(p), -0.97), np.full(len(p), 0.06)], 1)
    gaze /= np.linalg.norm(gaze, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((d * gaze).sum(1), -1, 1)))
    turn = np.arctan2(d[:, 2], d[:, 0] - gaze[:, 0])
    rgb = np.broadcast_to(WHITE, p.shape).copy()
    iris = mix(np.broadcast_to(AMBER, p.shape), EMBER, step(d[:, 2], 0.0, 0.6) + 0.25 * np.sin(turn * 17))
    rgb = mix(rgb, INK, step(47 - angle, 0, 3))
    rgb = mix(rgb, iris, step(43 - angle, 0, 4))
    rgb = mix(rgb, INK, step(24 - angle, 0, 4))
    for offset, size in (((-0.30, 0.0, 0.40), 15.0), ((0.30, 0.0, -0.28), 8.0)):
        spot = gaze + np.array(offset)
        spot /= np.linalg.norm(spot, axis=1, keepdims=True)
        away = np.degrees(np.arccos(np.clip((d * spot).sum(1), -1, 1)))
        rgb = mix(rgb, WHITE, step(size - away, 0, 4))
    lid = step(d[:, 2] + 0.14 * (np.abs(p[:, 0]) - EYE_CENTER[0]) / EYE_RADIUS, 0.58, 0.62)
    rgb = mix(rgb, INK, step(d[:, 2] + 0.14 * (np.abs(p[:, 0]) - EYE_CENTER[0]) / EYE_RADIUS, 0.50, 0.54))
    return mix(rgb, SKIN_DARK, lid)


def paint_hair(p: Array) -> Array:
    """Ember roots, flame tips, dark strands."""
    out = np.linalg.norm(p - [0, 0.005, 1.31], axis=1)
    rgb = mix(np.broadcast_to(EMBER, p.shape), FLAME, step(out, 0.19, 0.26))
    rgb = mix(rgb, GOLD, step(out, 0.255, 0.33))
    return mix(rgb, EMBER, 0.5 * step(np.sin(p[:, 0] * 420 + 2 * noise(p, 20, 2)), 0.4, 0.9))


def paint_skirt(p: Array) -> Array:
    """Plum cloth with pale checks and a gold hem that follows the points."""
    turn = np.arctan2(p[:, 1] - 0.012, p[:, 0])
    hem = SKIRT_HEM + 0.055 * (0.5 + 0.5 * np.cos(turn * 12))
    down = (SKIRT_TOP - p[:, 2]) / (SKIRT_TOP - hem)
    rgb = mix(np.broadcast_to(PLUM, p.shape), INK, 0.25 + 0.3 * noise(p, 35, 4))
    lines = np.maximum(step(np.cos(turn * 24), 0.86, 0.97), step(np.cos(down * 2 * np.pi * 5), 0.86, 0.97))
    rgb = mix(rgb, ROSE, 0.55 * lines)
    rgb = mix(rgb, GOLD, step(down, 0.84, 0.87))
    return mix(rgb, CAPE, step(down, 0.93, 0.955))


def paint_cape(p: Array) -> Array:
    """Crimson with a gold border and a sun on the back; the lining is dark."""
    down = np.clip((CAPE_LINE[0, 2] - p[:, 2]) / (CAPE_LINE[0, 2] - CAPE_LINE[-1, 2]), 0, 1.25)
    half = 0.125 + 0.145 * np.minimum(down, 1) ** 0.9
    across = np.abs(p[:, 0]) / half
    rgb = mix(np.broadcast_to(CAPE, p.shape), CAPE_DARK, 0.35 * down + 0.25 * noise(p, 18, 7))
    rgb = mix(rgb, CAPE_DARK, 0.35 * step(-np.cos(across * 3.2 * np.pi), 0.2, 1.0) * down)
    dx, dz = p[:, 0], p[:, 2] - 0.82
    radius, turn = np.hypot(dx, dz), np.arctan2(dz, dx)
    sun = 0.052 + 0.022 * step(np.cos(turn * 12), -0.2, 0.6)
    rgb = mix(rgb, GOLD, step(sun - radius, 0, 0.006))
    rgb = mix(rgb, CAPE, step(0.036 - radius, 0, 0.005))
    rgb = mix(rgb, GOLD, step(0.022 - radius, 0, 0.005))
    return mix(rgb, GOLD, step(across, 0.87, 0.90) * (1 - step(across, 0.955, 0.975)))


def paint_scarf(p: Array) -> Array:
    """Knitted bands."""
    turn = np.arctan2(p[:, 1], p[:, 0])
    band = np.sin(turn * 9 + (p[:, 2] - 1.045) * 30)
    rgb = mix(np.broadcast_to(CAPE, p.shape), CREAM, step(band, 0.45, 0.65))
    return mix(rgb, CAPE_DARK, 0.3 * step(np.sin(turn * 60) * np.sin(p[:, 2] * 500), 0.2, 0.6))


def paint_belt(p: Array) -> Array:
    """Leather with gold studs."""
    turn = np.arctan2(p[:, 0], -(p[:, 1] - 0.012))
    stud = np.hypot(((turn / (2 * np.pi) * 18) % 1 - 0.5) * 0.05, p[:, 2] - SKIRT_TOP - 0.005)
    return mix(np.broadcast_to(LEATHER, p.shape), GOLD, step(0.011 - stud, 0, 0.003))


def paint_buckle(p: Array) -> Array:
    """A gold frame around a red stone."""
    away = np.hypot(p[:, 0] / 0.046, (p[:, 2] - SKIRT_TOP - 0.005) / 0.040)
    return mix(np.broadcast_to(GOLD, p.shape), EMBER, step(0.62 - away, 0, 0.1))


def paint_fangs(p: Array) -> Array:
    """Ivory."""
    return np.broadcast_to(IVORY, p.shape).copy()


PAINT: dict[str, Callable[[Array], Array]] = {
    "body": paint_body, "horns": paint_horns, "eyes": paint_eyes, "fangs": paint_fangs, "hair": paint_hair,
    "belt": paint_belt, "buckle": paint_buckle, "skirt": paint_skirt, "cape": paint_cape,
    "scarf": paint_scarf,
}  # fmt: skip
"""Part name -> colour function."""
