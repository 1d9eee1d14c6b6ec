# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights that somebody else made: a folder with one file for each asset, checked as they are read.

`<asset>.npz` (arrays weights (N, B) and bones (B,) names) or RigNet's `<asset>.txt`. Rows are the splats in their
order; where the weights are those of a mesh's vertices, the mesh lies beside them as `<asset>.obj` (y up, as
`benchmarks.quality.export` writes it) and each splat takes the weights of the nearest place on it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import RiggedSplats
from gskin_addon.core.errors import InputError
from gskin_addon.core.files import read_arrays
from gskin_addon.core.job.skinned_files import read_surface, read_weights
from gskin_addon.core.rig.nearest import nearest_triangles

SUFFIXES = (".npz", ".txt")
SUM_TOLERANCE = 1e-3

FARTHEST = 0.05
"""Median distance of the splats to a mesh, in their diagonal, beyond which it is not in their place."""


@dataclass(frozen=True)
class Submitted:
    """weights (N, B) float32 on the asset's bones, rows sum to 1; digest: of the files that they come from; on_mesh:
    whether they came by a mesh."""

    weights: NDArray[np.float32]
    digest: str
    on_mesh: bool


def file_of(folder: Path, asset: str) -> Path | None:
    """The file of an asset in a folder, where there is one.

    Raises:
        InputError: there are two.
    """
    found = [path for suffix in SUFFIXES if (path := folder / f"{asset}{suffix}").is_file()]
    if len(found) > 1:
        raise InputError(f"'{folder}' has both {asset}.npz and {asset}.txt; leave one of them.")
    return found[0] if found else None


def digest_of(folder: Path, asset: str) -> str:
    """Ten hexadecimal digits that stand for an asset's files; "" without any."""
    path = file_of(folder, asset)
    if path is None:
        return ""
    found = hashlib.sha1(path.read_bytes())
    mesh = folder / f"{asset}.obj"
    if mesh.is_file():
        found.update(mesh.read_bytes())
    return found.hexdigest()[:10]


def read_submitted(folder: Path, asset: RiggedSplats) -> Submitted:
    """The weights for an asset.

    Raises:
        FileNotFoundError: the folder has none. InputError: they are damaged, hold pickled objects, are of other bones
            or splats, negative, not finite, or do not sum to 1.
    """
    path = file_of(folder, asset.name)
    if path is None:
        raise FileNotFoundError(f"'{folder}' has no {asset.name}.npz or {asset.name}.txt")
    weights = _on_bones(path, *_read(path, asset.skeleton.names), asset.skeleton.names)
    mesh = folder / f"{asset.name}.obj"
    count = len(asset.cloud.means)
    if mesh.is_file():
        verts, faces = read_surface(mesh)
        if len(weights) != len(verts):
            raise InputError(f"'{path}' has {len(weights):,} rows, '{mesh}' {len(verts):,} vertices; they must agree.")
        face, bary = nearest_triangles(asset.cloud.means, verts[faces])
        _check_place(mesh, asset.cloud.means, np.einsum("nk,nkd->nd", bary, verts[faces[face]]))
        weights = np.einsum("nk,nkb->nb", bary, weights[faces[face]])
    elif len(weights) != count:
        raise InputError(
            f"'{path}' has {len(weights):,} rows for {count:,} splats; give one for each splat, or the mesh that they "
            f"belong to as {asset.name}.obj beside it."
        )
    weights = weights / weights.sum(axis=1, keepdims=True)
    return Submitted(weights.astype(np.float32), digest_of(folder, asset.name), mesh.is_file())


def _check_place(mesh: Path, means: NDArray[Any], nearest: NDArray[Any]) -> None:
    """Raise InputError where the places on the mesh nearest to the splats (N, 3), (N, 3) are not theirs: it has other
    axes, another unit, or was brought to a unit cube."""
    distance = float(np.median(np.linalg.norm(means - nearest, axis=1)))
    size = float(np.linalg.norm(np.ptp(means, axis=0)))
    if distance > FARTHEST * size:
        raise InputError(
            f"'{mesh}' does not lie where the splats are: half of them are more than {distance / size:.0%} of their "
            "size away; write it with y up, in the place and size of proxy.obj."
        )


def _read(path: Path, bones: tuple[str, ...]) -> tuple[NDArray[Any], list[str]]:
    if path.suffix == ".txt":
        rig = read_weights(path, bones)
        return rig.weights, list(rig.bones)
    try:
        arrays = read_arrays(path, ("weights", "bones"))
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' cannot be read ({error}); it needs the arrays weights and bones.") from None
    weights, names = arrays["weights"], arrays["bones"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise InputError(f"'{path}' has bones that are no list of names; write the names as text.")
    if weights.ndim != 2 or weights.dtype.kind != "f" or weights.shape[1] != len(names):
        raise InputError(
            f"'{path}' has weights {weights.shape} of {weights.dtype} for {len(names)} bones; write floats (N, B)."
        )
    return weights, [str(name) for name in names]


def _on_bones(path: Path, weights: NDArray[Any], names: list[str], bones: tuple[str, ...]) -> NDArray[np.float64]:
    """Columns in the asset's order, float64; bones that are left out weigh nothing."""
    if len(set(names)) != len(names):
        raise InputError(f"'{path}' names a bone twice; give every bone one column.")
    strange = [name for name in names if name not in bones]
    if strange:
        raise InputError(f"'{path}' has the bone '{strange[0]}', which the skeleton lacks; use its {len(bones)} names.")
    if not np.isfinite(weights).all():
        raise InputError(f"'{path}' has weights that are not finite; write it again.")
    if (weights < 0).any():
        raise InputError(f"'{path}' has negative weights; write it again.")
    sums = weights.sum(axis=1, dtype=np.float64)
    if not len(weights) or float(np.abs(sums - 1).max()) > SUM_TOLERANCE:
        row = int(np.abs(sums - 1).argmax()) if len(weights) else 0
        total = float(sums[row]) if len(weights) else 0.0
        raise InputError(f"'{path}' has rows that do not sum to 1 (row {row}: {total:.4g}); normalise them.")
    out = np.zeros((len(weights), len(bones)))
    out[:, [bones.index(name) for name in names]] = weights
    return out
