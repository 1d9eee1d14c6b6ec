# SPDX-License-Identifier: GPL-3.0-or-later
"""Training samples: descriptions of bodies with their true weights, kept on disk."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files import read_arrays, write_arrays
from ...rig.kinematics import pose_transforms
from ...rig.lbs import skin_points
from ...rig.poses import random_axes, random_poses
from ...rig.skeleton import Skeleton
from ...skinning.learned.describe import describe_body
from ...skinning.learned.features import NAMES
from ...skinning.learned.parts import neighbourhoods
from ..rigged import RiggedMesh, textured
from . import creatures
from .examples import TrainingBody, augment, read_mesh_asset, sample_splats, without_unused_bones
from .proportions import change_proportions

Array = NDArray[Any]

ROWS = 500
PROPORTIONS_CHANGED = 0.6
"""Share of an asset's samples, after the first, with other proportions and another rest pose."""

VERSION = 9
"""Of the sample files; those of another version are made anew."""


@dataclass(frozen=True)
class TrainingSample:
    """bone (N, K) int16, values (N, K, F) float16, relation (B, B) int8, role (B,) int8, near and wide (N, k)
    int16, labels (N, 3) int16, points (N, 3) and heads (B, 3) float32 in units of the diagonal, parents (B,), truth
    (N, B) float16, valid (N,) bool, difficulty: mean posed-position error of the heat weights, in % of the
    diagonal."""

    bone: Array
    values: Array
    relation: Array
    role: Array
    near: Array
    wide: Array
    labels: Array
    points: Array
    heads: Array
    parents: Array
    truth: Array
    valid: Array
    difficulty: float

    def save(self, path: Path) -> None:
        """Write the file atomically, so that a killed run leaves no partial file."""
        columns = {name: np.asarray(value) for name, value in vars(self).items()}
        write_arrays(path, {"version": np.array(VERSION), "names": np.array(NAMES), **columns})

    @classmethod
    def load(cls, path: Path) -> TrainingSample:
        """Raises InputError for a file that is damaged or of another version."""
        names = [f.name for f in fields(cls)]
        try:
            columns = read_arrays(path, ["version", "names", *names])
        except (OSError, ValueError) as error:
            raise InputError(
                f"The training sample '{path}' cannot be read ({error}); delete it to have it made anew."
            ) from None
        version, features = columns.pop("version"), columns.pop("names")
        if not _is_ours(version, features):
            raise InputError(f"The training sample '{path}' has another version; delete it to have it made anew.")
        difficulty = float(columns.pop("difficulty"))
        return cls(**columns, difficulty=difficulty)

    def skeleton(self) -> Skeleton:
        """The bones, for poses, which do not depend on the tails."""
        names = tuple(str(i) for i in range(len(self.heads)))
        return Skeleton(names, self.parents, self.heads, self.heads + [0.0, 0.0, 0.01])


def make_sample(body: TrainingBody, rng: np.random.Generator, rows: int = ROWS) -> TrainingSample:
    """Describe a body at `rows` of its splats."""
    cloud, skeleton = body.cloud, body.skeleton
    described = describe_body(cloud, skeleton, rows=rows, resolution=int(rng.integers(56, 76)))
    chosen, size = described.rows, described.size
    at = described.index[chosen]
    points = described.points[chosen]
    near, wide = neighbourhoods(points, described.reach.distances[chosen])
    labels = [np.unique(column[chosen], return_inverse=True)[1] for column in described.parts.labels.T]
    centre = points.mean(axis=0)
    truth, valid = body.weights[at], body.valid[at]
    unit = (points - centre) / size
    tokens = described.description
    sample = TrainingSample(
        tokens.bone,
        tokens.values.astype(np.float16),
        tokens.relation,
        tokens.role,
        near.astype(np.int16),
        wide.astype(np.int16),
        np.stack(labels, axis=1).astype(np.int16),
        unit.astype(np.float32),
        ((skeleton.heads - centre) / size).astype(np.float32),
        skeleton.parents.astype(np.int16),
        truth.astype(np.float16),
        valid,
        0.0,
    )
    heat = described.reach.heat[chosen]
    poses = random_sample_poses(sample, 16, np.random.default_rng(0))
    error = np.linalg.norm(skin_points(unit, heat, poses) - skin_points(unit, truth, poses), axis=-1)
    return replace(sample, difficulty=float(100 * error[:, valid].mean()))


def random_sample_poses(sample: TrainingSample, count: int, rng: np.random.Generator) -> Array:
    """`count` random poses (P, B, 4, 4) as the paper draws them, about random axes."""
    skeleton, axes = sample.skeleton(), random_axes(count, rng)
    return pose_transforms(skeleton, random_poses(skeleton, axes, count, rng))


def seed_of(name: str, variant: int) -> int:
    """The seed of a variant of an asset, the same on every machine."""
    return zlib.crc32(f"{name}/{variant}".encode())


def sample_file(cache: Path, name: str, variant: int) -> Path:
    """The path of a sample in the cache."""
    return cache / f"{name}.{variant}.npz"


def asset_sample(npz: Path, name: str, variant: int, cache: Path) -> Path:
    """Make the sample of a variant unless the cache has it; returns its path. Variant 0 is the asset unchanged, without
    its unused bones."""
    path = sample_file(cache, name, variant)
    if not _current(path):
        rng = np.random.default_rng(seed_of(name, variant))
        mesh = read_mesh_asset(npz)
        if variant > 0 and rng.random() < PROPORTIONS_CHANGED:
            mesh = change_proportions(mesh, rng)
        body = _unchanged(mesh, rng) if variant == 0 else augment(sample_splats(mesh, rng), rng)
        make_sample(body, rng).save(path)
    return path


def _unchanged(mesh: RiggedMesh, rng: np.random.Generator) -> TrainingBody:
    skeleton, weights = without_unused_bones(mesh.skeleton, mesh.weights, mesh.used)
    from ...splats.from_mesh import sample_mesh

    cloud, face, bary = sample_mesh(mesh.verts, mesh.faces, mesh.corner_rgb, 6000, rng)
    cloud = textured(cloud, mesh, face, bary)
    sampled = np.einsum("nk,nkb->nb", bary, weights[mesh.faces[face]])
    total = sampled.sum(1, keepdims=True)
    return TrainingBody(cloud, skeleton, (sampled / np.maximum(total, 1e-9)).astype(np.float32), total[:, 0] > 0.5)


def creature_sample(seed: int, cache: Path) -> Path:
    """Make the sample of a generated creature unless the cache has it; returns its path."""
    path = sample_file(cache, "creature", seed)
    if not _current(path):
        rng = np.random.default_rng(seed_of("creature", seed))
        make_sample(augment(creatures.generate_creature(rng), rng), rng).save(path)
    return path


def _current(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        head = read_arrays(path, ["version", "names"])
    except (OSError, ValueError):
        return False  # damaged or foreign: made anew
    return _is_ours(head["version"], head["names"])


def _is_ours(version: Array, features: Array) -> bool:
    return bool(np.array_equal(version, VERSION) and np.array_equal(features, np.array(NAMES)))
