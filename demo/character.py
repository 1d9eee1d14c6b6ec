# SPDX-License-Identifier: GPL-3.0-or-later
"""Brindle, the sample character: geometry, colours, bones and true weights; the same on every run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.from_mesh import sample_mesh

from . import blender_tools, parts
from .paint import PAINT, step
from .shapes import merge
from .skeleton import bones

Array = NDArray[np.float64]
NAME = "Brindle"
VOXEL = 0.011
SMOOTHING = 7
LIGHT = np.array([-0.45, -0.65, 0.75]) / np.linalg.norm([-0.45, -0.65, 0.75])


@dataclass(frozen=True)
class Character:
    """verts (V, 3); faces (F, 3); corner_rgb (F, 3, 3); part (V,) index into `parts`; weights (V, B)."""

    verts: Array
    faces: NDArray[np.int64]
    corner_rgb: Array
    part: NDArray[np.int64]
    parts: tuple[str, ...]
    weights: Array
    bones: tuple[str, ...]
    rig: Any


def build() -> Character:
    """Model the character in an empty Blender scene; only its armature stays in the scene."""
    blender_tools.empty_scene()
    rig = blender_tools.make_armature(NAME)
    names = list(bones())
    body = blender_tools.fused(parts.body(), VOXEL, SMOOTHING)
    worn = parts.worn()
    labels = ["body", *worn]
    meshes = [body, *worn.values()]
    verts, faces = merge(meshes)
    part = parts.part_index(labels, meshes)

    capes = tuple(name for name in names if name.startswith("cape"))
    heat = blender_tools.bone_heat(body, rig, names, without=capes)
    weights = np.concatenate(
        [heat, *(_worn_weights(label, mesh[0], body[0], heat, names) for label, mesh in worn.items())]
    )
    openness = _smoothed(blender_tools.baked_openness((verts, faces), samples=12), faces, rounds=4)
    color = np.concatenate([PAINT[label](mesh[0]) for label, mesh in zip(labels, meshes, strict=True)])
    normal = _vertex_normals(verts, faces)
    light = 0.66 + 0.26 * np.clip(normal @ LIGHT, -0.4, 1) + 0.12 * normal[:, 2]
    shade = light * (0.38 + 0.62 * openness**0.8)
    # Occlusion of skin and cloth is never grey: the dark end keeps some warmth.
    color = np.clip(color * shade[:, None] ** np.array([0.85, 1.0, 0.95]) * 1.12, 0, 1)
    color = color.round(6)  # powers differ in the last bit from run to run

    # A capture has no splats where no camera could see: faces that are shut in are left out.
    seen = openness[faces].max(axis=1) > 0.04
    faces = faces[seen]
    return Character(verts, faces, color[faces], part, tuple(labels), weights, tuple(names), rig)


def to_splats(character: Character, count: int, seed: int) -> tuple[SplatCloud, Array]:
    """Splats of the surface (denser on the head, where the detail is) and their true weights (N, B)."""
    rng = np.random.default_rng(seed)
    c = character
    corners = c.verts[c.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    eyes = c.part[c.faces[:, 0]] == c.parts.index("eyes")
    face = ~eyes & (corners[:, :, 2].mean(1) > 1.12)
    regions = [(eyes, 4.0), (face, 1.8), (~eyes & ~face, 1.0)]
    shares = np.array([area[mask].sum() * density for mask, density in regions])
    counts = np.floor(count * shares / shares.sum()).astype(int)
    counts[-1] += count - counts.sum()
    clouds, weights = [], []
    for (mask, _), share in zip(regions, counts, strict=True):
        cloud, index, bary = sample_mesh(
            c.verts, c.faces[mask], c.corner_rgb[mask], int(share), rng, below=0.04, scatter=0.0006
        )
        clouds.append(cloud)
        weights.append(np.einsum("nk,nkb->nb", bary, c.weights[c.faces[mask][index]]))
    order = rng.permutation(count)  # nothing may be read off the order of the splats
    columns = {
        name: np.concatenate([getattr(cloud, name) for cloud in clouds])[order]
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    columns["scales"] *= np.float32(1.15)  # closes the last gaps that a random cover leaves
    truth = np.concatenate(weights)[order]
    return SplatCloud(**columns), truth / truth.sum(axis=1, keepdims=True)


def _worn_weights(label: str, verts: Array, body: Array, heat: Array, names: list[str]) -> Array:
    """True weights (V, B) of a separate part, by what an artist would paint."""
    weights = np.zeros((len(verts), len(names)))
    column = names.index
    if label in ("horns", "eyes", "fangs", "hair"):
        weights[:, column("head")] = 1.0
    elif label == "scarf":
        neck = step(verts[:, 2], 1.02, 1.09) * 0.6
        weights[:, column("neck")], weights[:, column("chest")] = neck, 1 - neck
    elif label == "cape":
        middle = 0.5 * (parts.CAPE_LINE[:-1, 2] + parts.CAPE_LINE[1:, 2])
        stations = np.array([parts.CAPE_LINE[0, 2] + 0.02, *middle])
        owners = ["chest", "cape.1", "cape.2", "cape.3"]
        for i, owner in enumerate(owners):
            hat = np.interp(-verts[:, 2], -stations, np.eye(len(owners))[i])
            weights[:, column(owner)] = hat
    elif label == "skirt":
        down = (parts.SKIRT_TOP - verts[:, 2]) / (parts.SKIRT_TOP - parts.SKIRT_HEM)
        legs = 0.8 * step(down, 0.05, 0.9)
        left = step(verts[:, 0], -0.10, 0.10)
        weights[:, column("hips")] = 1 - legs
        weights[:, column("thigh.L")], weights[:, column("thigh.R")] = legs * left, legs * (1 - left)
    else:  # belt and buckle lie tight on the body and follow it
        weights = heat[_nearest(verts, body)]
        if label == "buckle":
            weights[:] = weights.mean(axis=0)
    return weights / weights.sum(axis=1, keepdims=True)


def _nearest(points: Array, others: Array) -> NDArray[np.int64]:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[1], np.int64)


def _smoothed(values: Array, faces: NDArray[np.int64], rounds: int) -> Array:
    """Values of vertices (V,), averaged with their neighbours `rounds` times; few rays leave noise."""
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    count = np.bincount(a, minlength=len(values)) + np.bincount(b, minlength=len(values)) + 1
    for _ in range(rounds):
        total = values + np.bincount(a, values[b], len(values)) + np.bincount(b, values[a], len(values))
        values = total / count
    return values


def _vertex_normals(verts: Array, faces: NDArray[np.int64]) -> Array:
    corners = verts[faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.stack(
        [np.bincount(faces.ravel(), np.repeat(face[:, k], 3), minlength=len(verts)) for k in range(3)], axis=1
    )
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
