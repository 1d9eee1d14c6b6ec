# SPDX-License-Identifier: GPL-3.0-or-later
"""Described bodies with their true weights, kept on disk: what the network trains on."""

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
from ...skinning.learned.describe import look_at
from ...skinning.learned.features import NAMES
from ...skinning.learned.parts import neighbourhoods
from ..rigged import RiggedMesh
from . import creatures
from .examples import Subject, cover, disturb, only_used, read_mesh_asset
from .proportions import reshape

Array = NDArray[Any]

ROWS = 500
RESHAPED = 0.6
"""Share of an asset's further lessons in which it has other proportions and another rest pose."""

VERSION = 9
"""Of the lesson files; other versions are made anew."""


@dataclass(frozen=True)
class Lesson:
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
        """Write all at once, so that a killed run leaves no half file."""
        columns = {name: np.asarray(value) for name, value in vars(self).items()}
        write_arrays(path, {"version": np.array(VERSION), "names": np.array(NAMES), **columns})

    @classmethod
    def load(cls, path: Path) -> Lesson:
        """Raises InputError for a file that is damaged or of another version."""
        names = [f.name for f in fields(cls)]
        try:
            columns = read_arrays(path, ["version", "names", *names])
        except (OSError, ValueError) as error:
            raise InputError(f"The lesson '{path}' cannot be read ({error}); delete it to have it made anew.") from None
        version, features = columns.pop("version"), columns.pop("names")
        if not _is_ours(version, features):
            raise InputError(f"The lesson '{path}' has another version; delete it to have it made anew.")
        difficulty = float(columns.pop("difficulty"))
        return cls(**columns, difficulty=difficulty)

    def skeleton(self) -> Skeleton:
        """The bones, for poses; their tails are of no importance there."""
        names = tuple(str(i) for i in range(len(self.heads)))
        return Skeleton(names, self.parents, self.heads, self.heads + [0.0, 0.0, 0.01])


def make_lesson(subject: Subject, rng: np.random.Generator, rows: int = ROWS) -> Lesson:
    """Describe a subject."""
    cloud, skeleton = subject.cloud, subject.skeleton
    body = look_at(cloud, skeleton, rows=rows, resolution=int(rng.integers(56, 76)))
    at = body.index[body.rows]
    points = body.points[body.rows]
    near, wide = neighbourhoods(points, body.reach.distances[body.rows])
    labels = [np.unique(column[body.rows], return_inverse=True)[1] for column in body.parts.labels.T]
    centre = points.mean(axis=0)
    truth, valid = subject.weights[at], subject.valid[at]
    unit = (points - centre) / body.size
    described = body.description
    lesson = Lesson(
        described.bone,
        described.values.astype(np.float16),
        described.relation,
        described.role,
        near.astype(np.int16),
        wide.astype(np.int16),
        np.stack(labels, axis=1).astype(np.int16),
        unit.astype(np.float32),
        ((skeleton.heads - centre) / body.size).astype(np.float32),
        skeleton.parents.astype(np.int16),
        truth.astype(np.float16),
        valid,
        0.0,
    )
    heat = body.reach.heat[body.rows]
    poses = posed_lesson(lesson, 16, np.random.default_rng(0))
    error = np.linalg.norm(skin_points(unit, heat, poses) - skin_points(unit, truth, poses), axis=-1)
    return replace(lesson, difficulty=float(100 * error[:, valid].mean()))


def posed_lesson(lesson: Lesson, count: int, rng: np.random.Generator) -> Array:
    """`count` random poses (P, B, 4, 4) as the paper draws them, about random axes."""
    skeleton, axes = lesson.skeleton(), random_axes(count, rng)
    return pose_transforms(skeleton, random_poses(skeleton, axes, count, rng))


def seed_of(name: str, variant: int) -> int:
    """A seed of its own for each variant of each asset, the same everywhere."""
    return zlib.crc32(f"{name}/{variant}".encode())


def lesson_file(cache: Path, name: str, variant: int) -> Path:
    """Where a lesson is kept."""
    return cache / f"{name}.{variant}.npz"


def asset_lesson(npz: Path, name: str, variant: int, cache: Path) -> Path:
    """Make the lesson of a variant unless it is there. Variant 0 is the asset as it is, with its used bones."""
    path = lesson_file(cache, name, variant)
    if not _current(path):
        rng = np.random.default_rng(seed_of(name, variant))
        mesh = read_mesh_asset(npz)
        if variant > 0 and rng.random() < RESHAPED:
            mesh = reshape(mesh, rng)
        subject = _plain(mesh, rng) if variant == 0 else disturb(cover(mesh, rng), rng)
        make_lesson(subject, rng).save(path)
    return path


def _plain(mesh: RiggedMesh, rng: np.random.Generator) -> Subject:
    skeleton, weights = only_used(mesh.skeleton, mesh.weights, mesh.used)
    from ...splats.from_mesh import sample_mesh

    cloud, face, bary = sample_mesh(mesh.verts, mesh.faces, mesh.corner_rgb, 6000, rng)
    sampled = np.einsum("nk,nkb->nb", bary, weights[mesh.faces[face]])
    total = sampled.sum(1, keepdims=True)
    return Subject(cloud, skeleton, (sampled / np.maximum(total, 1e-9)).astype(np.float32), total[:, 0] > 0.5)


def creature_lesson(seed: int, cache: Path) -> Path:
    """Make the lesson of a generated creature unless it is there."""
    path = lesson_file(cache, "creature", seed)
    if not _current(path):
        rng = np.random.default_rng(seed_of("creature", seed))
        make_lesson(disturb(creatures.generate(rng), rng), rng).save(path)
    return path


def _current(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        head = read_arrays(path, ["version", "names"])
    except (OSError, ValueError):
        return False  # half a file, or one of somebody else: made anew
    return _is_ours(head["version"], head["names"])


def _is_ours(version: Array, features: Array) -> bool:
    return bool(np.array_equal(version, VERSION) and np.array_equal(features, np.array(NAMES)))
