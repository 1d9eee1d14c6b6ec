# SPDX-License-Identifier: GPL-3.0-or-later
"""The sample character's geometry: a body of fused tubes and the separate parts that it wears."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .shapes import Mesh, cloth, ellipsoid, merge, mirrored, smooth_line, torus, tube

EYE_CENTER = np.array([0.086, -0.122, 1.322])
EYE_RADIUS = 0.070
CAPE_LINE = np.array([[0, 0.15, 1.03], [0, 0.21, 0.86], [0, 0.27, 0.72], [0, 0.35, 0.56]])
SKIRT_TOP, SKIRT_HEM = 0.71, 0.39


def body() -> Mesh:
    """Overlapping closed shapes of torso, head, limbs, ears and tail; a voxel remesh fuses them."""
    left = [
        tube([(0.06, 0.02, 0.985), (0.14, 0.03, 0.965), (0.235, 0.04, 0.905), (0.335, 0.042, 0.84),
              (0.43, 0.02, 0.775), (0.515, 0.0, 0.71)], [0.062, 0.060, 0.052, 0.047, 0.047, 0.039]),
        ellipsoid((0.565, -0.008, 0.672), (0.052, 0.04, 0.05)),
        tube([(0.585, -0.01, 0.66), (0.625, -0.015, 0.625), (0.655, -0.022, 0.585)], [0.024, 0.022, 0.016]),
        tube([(0.58, -0.035, 0.665), (0.615, -0.055, 0.635), (0.635, -0.068, 0.60)], [0.022, 0.021, 0.015]),
        tube([(0.58, 0.022, 0.655), (0.61, 0.035, 0.62), (0.625, 0.04, 0.585)], [0.022, 0.020, 0.015]),
        tube([(0.55, -0.025, 0.69), (0.565, -0.065, 0.69), (0.585, -0.095, 0.675)], [0.023, 0.021, 0.015]),
        tube([(0.095, 0.02, 0.60), (0.11, 0.01, 0.47), (0.125, -0.005, 0.34), (0.132, 0.02, 0.20),
              (0.135, 0.03, 0.10)], [0.092, 0.080, 0.062, 0.056, 0.052]),
        tube([(0.135, 0.045, 0.058), (0.14, -0.03, 0.062), (0.15, -0.135, 0.052)], [0.060, 0.064, 0.066],
             flat=(0, 0, 1, 0.86)),
        tube([(0.13, 0.01, 1.325), (0.24, 0.03, 1.375), (0.35, 0.055, 1.43), (0.475, 0.075, 1.475)],
             [0.052, 0.068, 0.05, 0.008], flat=(0.15, 1, 0, 0.42)),
        ellipsoid((0.092, -0.10, 1.222), (0.078, 0.075, 0.060)),
    ]  # fmt: skip
    middle = [
        tube([(0, 0.02, 0.60), (0, 0.005, 0.70), (0, 0.01, 0.83), (0, 0.02, 0.95), (0, 0.02, 1.00)],
             [0.135, 0.142, 0.138, 0.118, 0.09], flat=(0, 1, 0, 0.82)),
        tube([(0, 0.02, 1.0), (0, 0.0, 1.12)], [0.066, 0.062]),
        ellipsoid((0, 0.005, 1.315), (0.202, 0.182, 0.185)),
        ellipsoid((0, -0.15, 1.222), (0.098, 0.112, 0.066)),
        tube([(0, 0.07, 0.60), (0, 0.25, 0.48), (0, 0.42, 0.41), (0, 0.60, 0.43), (0, 0.74, 0.54),
              (0, 0.79, 0.66)], [0.088, 0.066, 0.054, 0.044, 0.035, 0.027]),
        tube([(0, 0.775, 0.62), (0, 0.80, 0.70), (0, 0.80, 0.78), (0, 0.775, 0.86)],
             [0.022, 0.075, 0.052, 0.006], flat=(0, 1, 0, 0.4)),
    ]  # fmt: skip
    return merge([*middle, *left, *(mirrored(mesh) for mesh in left)])


def worn() -> dict[str, Mesh]:
    """Name -> closed mesh of every part that is not fused with the body."""
    horn = tube([(0.085, -0.02, 1.43), (0.135, 0.0, 1.53), (0.165, 0.055, 1.60), (0.155, 0.125, 1.655),
                 (0.12, 0.17, 1.715)], [0.046, 0.040, 0.031, 0.020, 0.005], steps=12)  # fmt: skip
    eye = ellipsoid(EYE_CENTER, np.full(3, EYE_RADIUS), rings=40, segments=56)
    fang = tube([(0.052, -0.214, 1.218), (0.054, -0.226, 1.198), (0.054, -0.229, 1.178)], [0.013, 0.010, 0.003])
    return {
        "horns": merge([horn, mirrored(horn)]),
        "eyes": merge([eye, mirrored(eye)]),
        "fangs": merge([fang, mirrored(fang)]),
        "hair": _hair(),
        "belt": torus((0, 0.012, SKIRT_TOP + 0.005), (0.146, 0.122), (0.018, 0.030)),
        "buckle": ellipsoid((0, -0.128, SKIRT_TOP + 0.005), (0.046, 0.016, 0.040)),
        "skirt": _skirt(),
        "cape": _cape(),
        "scarf": torus((0, 0.012, 1.055), (0.102, 0.094), (0.048, 0.052)),
    }


def _hair() -> Mesh:
    """A crest of soft locks from the brow over the back of the head."""
    locks = []
    for i, angle in enumerate(np.radians([-58, -34, -10, 16, 42, 68, 92])):
        for x in (-0.045, 0.0, 0.045) if i < 5 else (0.0,):
            root = np.array([x, 0.165 * np.sin(angle) + 0.005, 1.31 + 0.165 * np.cos(angle)])
            out = np.array([x * 2.5, np.sin(angle), np.cos(angle)])
            length = (0.13 if x == 0 else 0.10) * (1.0 - 0.05 * i)
            tip = root + length * out + np.array([0, 0.075, 0.0])
            middle = 0.5 * (root + tip) + np.array([0, -0.012, 0.02])
            locks.append(tube([root, middle, tip], [0.036, 0.028, 0.005], steps=6, segments=14))
    return merge(locks)


def _skirt() -> Mesh:
    """A kilt around the hips, open behind for the tail, with a pointed hem."""
    turn = np.linspace(np.radians(118), np.radians(422), 121)  # 90 degrees is the back
    down = np.linspace(0, 1, 28)[:, None]
    point = 0.5 + 0.5 * np.cos(turn * 12)
    hem = SKIRT_HEM + 0.055 * point
    z = SKIRT_TOP + (hem - SKIRT_TOP) * down
    fold = 0.012 * np.sin(turn * 12) * down
    flare = down**0.8
    x = (0.148 + 0.105 * flare + fold) * np.cos(turn)
    y = 0.012 + (0.128 + 0.095 * flare + fold) * np.sin(turn)
    grid = np.stack([x, y, np.broadcast_to(z, x.shape)], axis=2)
    return cloth(grid[:, ::-1], 0.010)


def _cape() -> Mesh:
    """A cape that falls from the shoulders behind the back, with three soft folds and a swallow tail."""
    line = smooth_line(CAPE_LINE, 14)
    down = np.linspace(0, 1, len(line))[:, None]
    across = np.linspace(-1, 1, 81)[None, :]
    half = 0.125 + 0.145 * down**0.9
    fold = 0.020 * np.cos(across * 3.2 * np.pi) * down
    x = across * half
    wrap = -0.085 * np.abs(across) ** 2.2 * (1 - 0.55 * down)
    y = line[:, 1:2] + wrap + fold
    z = line[:, 2:3] - 0.055 * down**2 * np.abs(across) ** 1.3 * 1.5 + 0.02 * (1 - down) * (1 - across**2)
    return cloth(np.stack([x, y, z], axis=2)[:, ::-1], 0.011)


def part_index(names: list[str], meshes: list[Mesh]) -> NDArray[np.int64]:
    """For each vertex of the merged meshes, the index of its part."""
    return np.repeat(np.arange(len(names)), [len(verts) for verts, _ in meshes])
