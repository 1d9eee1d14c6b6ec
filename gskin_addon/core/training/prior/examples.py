# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged bodies for training: read from files, augmented, and covered with splats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...rig.quaternion import axis_angle_to_matrix
from ...rig.skeleton import Skeleton
from ...splats.cloud import SH_C0, SplatCloud
from ...splats.from_mesh import sample_mesh
from ..rigged import RiggedMesh, read_rigged_mesh, textured

Array = NDArray[Any]


@dataclass(frozen=True)
class TrainingBody:
    """Splats with known weights (N, B), rows sum to 1; valid (N,): False for strays, which do not count."""

    cloud: SplatCloud
    skeleton: Skeleton
    weights: Array
    valid: Array


def read_mesh_asset(path: Path) -> RiggedMesh:
    """A rigged mesh of the layout in docs/training.md, every bone with a length and without a rest matrix."""
    mesh = read_rigged_mesh(path)
    size, old = np.ptp(mesh.verts, axis=0).max(), mesh.skeleton
    tails = old.tails.copy()
    tails[np.linalg.norm(tails - old.heads, axis=1) < 1e-6 * size] += np.array([0.0, 0.0, 1e-3]) * size
    # Whatever the file says: a bone that moves almost nothing cannot be learned.
    used = mesh.weights.max(0) > 0.01
    return replace(mesh, skeleton=Skeleton(old.names, old.parents, old.heads, tails), used=used, clip=None)


def without_unused_bones(skeleton: Skeleton, weights: Array, used: Array) -> tuple[Skeleton, Array]:
    """Skeleton and weights without the unused bones; used (B,). Raises InputError if all are unused."""
    if not used.any():
        raise InputError("An asset has no bone with weights; leave it out of the catalogue.")
    return skeleton.subset(used), weights[:, used]


def sample_splats(mesh: RiggedMesh, rng: np.random.Generator) -> TrainingBody:
    """Scale and rotate the mesh at random and cover it with splats, as a capture or a generator might."""
    scale = np.exp(rng.normal(0, 0.12, 3)) if rng.random() < 0.5 else np.ones(3)
    turn = axis_angle_to_matrix(np.array([[0.0, 0.0, 1.0]]), rng.uniform(-np.pi, np.pi, 1))[0]
    if rng.random() < 0.3:
        axis = rng.normal(size=(1, 3))
        turn = axis_angle_to_matrix(axis / np.linalg.norm(axis), rng.uniform(0, np.pi, 1))[0]
    matrix = turn * scale
    skeleton = mesh.skeleton
    keep_idle = rng.random() < 0.35
    weights = mesh.weights
    if not keep_idle:
        skeleton, weights = without_unused_bones(skeleton, weights, mesh.used)
    skeleton = Skeleton(skeleton.names, skeleton.parents, skeleton.heads @ matrix.T, skeleton.tails @ matrix.T)
    cloud, face, bary = sample_mesh(
        mesh.verts @ matrix.T,
        mesh.faces,
        mesh.corner_rgb,
        int(rng.integers(4000, 6000)),
        rng,
        below=rng.uniform(0.05, 0.3),
        scatter=float(np.exp(rng.uniform(np.log(5e-4), np.log(5e-3)))),
    )
    cloud = textured(cloud, mesh, face, bary)
    sampled = np.einsum("nk,nkb->nb", bary, weights[mesh.faces[face]])
    sampled /= np.maximum(sampled.sum(1, keepdims=True), 1e-9)
    return TrainingBody(cloud, skeleton, sampled.astype(np.float32), sampled.sum(1) > 0.5)


def augment(body: TrainingBody, rng: np.random.Generator) -> TrainingBody:
    """Augment a body at random: split, drop, move or add bones, replace their tails, change colours, add strays."""
    from . import rig_changes as change

    size = float(np.linalg.norm(np.ptp(body.cloud.means, axis=0)))
    points = body.cloud.means.astype(np.float64)
    skeleton, weights = body.skeleton, body.weights
    if rng.random() < 0.2:
        skeleton, weights = change.split_bones(skeleton, weights, points, rng, int(rng.integers(1, 5)), size)
    if rng.random() < 0.2:
        skeleton, weights = change.drop_bones(skeleton, weights, rng, 1 + int(0.1 * skeleton.count * rng.random()))
    if rng.random() < 0.35:
        skeleton = change.move_joints(skeleton, rng, rng.uniform(0.005, 0.05) * size, size)
    if rng.random() < 0.2:
        skeleton, weights = change.add_idle_bones(skeleton, weights, rng, int(rng.integers(1, 5)), size)
    if rng.random() < 0.12:
        skeleton = change.replace_tails(skeleton, rng, size)
    cloud = augment_colors(body.cloud, rng)
    changed = TrainingBody(cloud, skeleton, weights, body.valid)
    return add_strays(changed, rng, size) if rng.random() < 0.15 else changed


def augment_colors(cloud: SplatCloud, rng: np.random.Generator) -> SplatCloud:
    """Random changes of the colours: none, uniform grey, or noise, shading and texture."""
    color, kind = cloud.base_colors().astype(np.float64), rng.random()
    if kind < 0.45:
        return cloud
    if kind < 0.55:
        color[:] = 0.5
    else:
        color = 0.1 + 0.8 * color * rng.uniform(0.5, 1.0)
    if kind > 0.7:
        light = rng.normal(size=3)
        middle = cloud.means.mean(0)
        along = (cloud.means - middle) @ (light / np.linalg.norm(light))
        color *= 1 + rng.uniform(0, 0.4) * (along / (np.abs(along).max() + 1e-9))[:, None]
    if kind > 0.8:
        size = np.ptp(cloud.means, axis=0).max()
        for _ in range(4):
            wave = rng.normal(0, 2 * np.pi * rng.uniform(2, 12) / size, 3)
            color += rng.normal(0, 0.05, 3) * np.sin(cloud.means @ wave + rng.uniform(0, 6.3))[:, None]
    color += rng.normal(0, rng.uniform(0, 0.04), color.shape)
    return replace(cloud, sh=((color - 0.5) / SH_C0)[:, None].astype(np.float32))


def add_strays(body: TrainingBody, rng: np.random.Generator, size: float) -> TrainingBody:
    """Add up to 1.5 % more splats around the object, which are not valid."""
    count = int(rng.uniform(0.002, 0.015) * body.cloud.count)
    picked = rng.integers(0, body.cloud.count, count)
    strays = body.cloud.select(picked)
    strays = replace(strays, means=strays.means + rng.normal(0, 0.06 * size, (count, 3)).astype(np.float32))
    both = {
        name: np.concatenate([getattr(body.cloud, name), getattr(strays, name)])
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    weights = np.concatenate([body.weights, body.weights[picked]])
    valid = np.concatenate([body.valid, np.zeros(count, bool)])
    return TrainingBody(SplatCloud(**both), body.skeleton, weights, valid)
