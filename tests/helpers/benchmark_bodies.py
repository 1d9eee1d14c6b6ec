# SPDX-License-Identifier: GPL-3.0-or-later
"""Made-up subjects for the benchmark's methods: a capsule on two bones, and results out of thin air."""

from __future__ import annotations

import numpy as np

from benchmarks.assets import RiggedSplats, Surface
from benchmarks.quality.results import OK, OWN, Result
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.splats.from_mesh import sample_mesh


def capsule(rings: int = 25, sides: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """A closed capsule along x from -0.2 to 2.2, radius 0.2; normals outwards."""
    along = np.linspace(0, np.pi, 7)[1:-1]
    cap = np.stack([-0.2 * np.cos(along), 0.2 * np.sin(along)], axis=1)
    side = np.stack([np.linspace(0, 2, rings), np.full(rings, 0.2)], axis=1)
    profile = np.concatenate([cap[:2], side, cap[3:] + (2, 0)])
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    body = np.stack([
        np.repeat(profile[:, 0], sides),
        np.outer(profile[:, 1], np.cos(angle)).ravel(),
        np.outer(profile[:, 1], np.sin(angle)).ravel(),
    ], axis=1)  # fmt: skip
    verts = np.concatenate([body, [[-0.2, 0, 0], [2.2, 0, 0]]])
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + j).ravel(), (i * sides + (j + 1) % sides).ravel()
    faces = [np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)]
    ring, last = np.arange(sides), (len(profile) - 1) * sides
    turn = (ring + 1) % sides
    faces.append(np.stack([turn, ring, np.full(sides, len(body))], 1))
    faces.append(np.stack([last + ring, last + turn, np.full(sides, len(body) + 1)], 1))
    return verts, np.concatenate(faces)


def two_bones() -> Skeleton:
    """Head to tail from 0 over 1 to 2 along x."""
    heads = np.array([[0.0, 0, 0], [1, 0, 0]])
    return Skeleton(("lower", "upper"), np.array([-1, 0]), heads, heads + (1.0, 0, 0))


def capsule_asset(count: int = 3000) -> RiggedSplats:
    """Splats on the capsule, with a linear blend of 0.4 around the joint as the truth, and a clip that bends it."""
    verts, faces = capsule()
    color = np.tile([0.8, 0.4, 0.2], (len(faces), 3, 1))
    color[:, :, 1] = 0.5 + 0.4 * np.sin(6 * verts[faces][:, :, 0])
    cloud, face, bary = sample_mesh(verts, faces, color, count, np.random.default_rng(0))
    upper = np.clip((cloud.means[:, 0] - 0.8) / 0.4, 0, 1)
    clip = np.tile(np.eye(4), (5, 2, 1, 1))
    for frame, angle in enumerate(np.linspace(0, 1.2, 5)):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        clip[frame, 1, :3, :3] = turn
        clip[frame, 1, :3, 3] = np.array([1, 0, 0]) - turn @ [1, 0, 0]
    weights = np.stack([1 - upper, upper], axis=1).astype(np.float32)
    return RiggedSplats("capsule", cloud, two_bones(), weights, clip, Surface(verts, faces, face, bary))


def result(asset: str, method: str, error: float, **other: object) -> Result:
    """A result with the given error; its PSNR is 30 - error."""
    values = {
        "asset": asset, "category": "animal", "family": "f", "method": method, "skeleton": OWN, "protocol": "p",
        "bones": 2, "status": OK, "note": "", "seconds": 1.0,
        "score": {"error": error, "error95": 2 * error, "random_error": error / 2, "random_error95": error,
                  "psnr": 30.0 - error, "ssim": 0.9, "lpips": None, "l1": 0.1},
    }  # fmt: skip
    return Result(**{**values, **other})  # type: ignore[arg-type]
