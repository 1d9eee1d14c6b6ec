# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splats <-> the columns of a 3DGS PLY file: log scale, logit opacity, raw quaternion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cloud import MAX_SH_DEGREE, SH_C0, AnyArray, FloatArray, SplatCloud

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
RGB = ("red", "green", "blue")
"""Colours of files without harmonics, in place of COLOR."""
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
FILTER = "filter_3D"
"""Mip-Splatting's smoothing filter (a standard deviation), where it was not fused into scales and opacity."""
REQUIRED = (*MEANS, *COLOR, "opacity", *SCALES, *QUATS)
"""Properties that every 3DGS file has; normals and f_rest_* may be missing, and of the scales the last ones."""

THIN = 1e-3
"""Thickness of a splat that its file has as a flat disc (2DGS: two scales), over the smaller of its two scales."""

REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1))
"""Number of f_rest_* properties of degree 0, 1, 2, 3, 4."""

# exp(-105) and the logistic function at -105 round to 0 in float32, at 25 the latter rounds to 1.
_LOWEST, _HIGHEST = -105.0, 25.0


def rest_names(count: int) -> tuple[str, ...]:
    """Names of `count` f_rest properties."""
    return tuple(f"f_rest_{index}" for index in range(count))


def standard_names(rest: int) -> tuple[str, ...]:
    """All properties of the INRIA layout with `rest` f_rest values, in its order."""
    return (*MEANS, *NORMALS, *COLOR, *rest_names(rest), "opacity", *SCALES, *QUATS)


def empty_cloud(count: int, rest: int) -> SplatCloud:
    """A cloud of `count` splats with room for `rest` f_rest values; contents undefined."""
    return SplatCloud(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, 1 + rest // 3, 3), np.float32),
    )


def decode_opacity(raw: AnyArray) -> FloatArray:
    """Opacity 0..1 from logits (N,): the logistic function, in double precision."""
    with np.errstate(over="ignore"):
        opacity = 1.0 / (1.0 + np.exp(-np.ascontiguousarray(raw, dtype=np.float64)))
    return opacity.astype(np.float32)


def encode_opacity(opacity: FloatArray) -> FloatArray:
    """Logits (N,) of opacities; finite also for 0 and 1, and decoding to them."""
    value = np.clip(np.ascontiguousarray(opacity, dtype=np.float64), 0.0, 1.0)
    with np.errstate(divide="ignore"):
        logit = np.log(value) - np.log1p(-value)
    return np.clip(logit, _LOWEST, _HIGHEST).astype(np.float32)


def decode_color(raw: AnyArray) -> FloatArray:
    """The constant harmonic (N,) of colours: whole numbers up to the largest of their type, or 0 to 1."""
    largest = np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else 1.0
    return ((np.ascontiguousarray(raw, dtype=np.float64) / largest - 0.5) / SH_C0).astype(np.float32)


def decode_scale(raw: AnyArray) -> FloatArray:
    """Linear scale from log scale (N,); infinite where float32 cannot hold it."""
    with np.errstate(over="ignore"):
        return np.exp(np.ascontiguousarray(raw, dtype=np.float64)).astype(np.float32)


def encode_scale(scale: FloatArray) -> FloatArray:
    """Log scale (N,) of linear scales; finite also for 0, and decoding to it."""
    with np.errstate(divide="ignore"):
        return np.maximum(np.log(np.ascontiguousarray(scale, dtype=np.float64)), _LOWEST).astype(np.float32)


def decode_quats(raw: NDArray[Any]) -> FloatArray:
    """Unit quaternions from raw ones (N, 4); NaN where the norm is 0."""
    quats = np.ascontiguousarray(raw, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return (quats / np.sqrt(np.einsum("ni,ni->n", quats, quats))[:, None]).astype(np.float32)


def decode_rows(
    columns: Mapping[str, AnyArray], cloud: SplatCloud, rows: slice, rest: int
) -> NDArray[np.bool_]:
    """Fill `rows` of `cloud` from raw columns; True (M,) where every decoded value is finite.

    A quaternion of norm 0 counts as not finite. A logit opacity of +-inf is opacity 1 or 0, a log scale of -inf is
    size 0. Two scales are a disc of the thickness `THIN`, one is a ball. A column `FILTER` is fused: s' = sqrt(s^2 +
    f^2), and the opacity times sqrt(det / det') (Mip-Splatting, Yu et al. 2024, `create_fused_ply`).
    """
    with np.errstate(over="ignore"):
        for axis, name in enumerate(MEANS):
            cloud.means[rows, axis] = columns[name]
        for channel, name in enumerate(COLOR):
            cloud.sh[rows, 0, channel] = columns[name]
        bands = rest // 3
        for index, name in enumerate(rest_names(rest)):
            cloud.sh[rows, 1 + index % bands, index // bands] = columns[name]
    present = [name for name in SCALES if name in columns]
    sizes = np.stack([decode_scale(columns[name]) for name in present], axis=1)
    cloud.opacities[rows] = decode_opacity(columns["opacity"])
    if FILTER in columns:
        sizes, kept = _fuse(sizes, columns[FILTER])
        cloud.opacities[rows] *= kept
    cloud.scales[rows, : len(present)] = sizes
    if len(present) == 2:
        cloud.scales[rows, 2] = THIN * sizes.min(axis=1)
    elif len(present) == 1:
        cloud.scales[rows, 1:] = sizes
    cloud.quats[rows] = decode_quats(np.stack([columns[name] for name in QUATS], axis=1))
    valid = np.isfinite(cloud.opacities[rows])
    for values in (cloud.means, cloud.scales, cloud.quats, cloud.sh.reshape(cloud.count, -1)):
        valid &= np.isfinite(values[rows]).all(axis=1)
    return valid


def _fuse(sizes: FloatArray, raw: AnyArray) -> tuple[FloatArray, FloatArray]:
    """Scales (M, k) widened by the filters (M,), and what the opacities must be multiplied by (M,)."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        wide = np.hypot(sizes.astype(np.float64), raw.astype(np.float64)[:, None])
        kept = np.where(wide > 0.0, sizes / wide, 1.0).prod(axis=1)
        kept[np.isnan(raw)] = np.nan
        return wide.astype(np.float32), kept.astype(np.float32)


def is_lossy(name: str, code: str) -> bool:
    """Whether decoding the standard column `name` of NumPy type `code` loses what the file held."""
    return name in ("opacity", *SCALES, *QUATS) or code == "f8"


def encode_rows(cloud: SplatCloud, rows: slice, rest: int) -> dict[str, AnyArray]:
    """Raw columns of `rows`: the stored value where it still decodes to the cloud's, else the encoded one."""
    part = cloud.select(rows)
    columns: dict[str, AnyArray] = {}
    for axis, name in enumerate(MEANS):
        columns[name] = _encode_mean(part, name, axis)
    for channel, name in enumerate(COLOR):
        columns[name] = _stored_or(part, name, part.sh[:, 0, channel])
    bands = rest // 3
    for index, name in enumerate(rest_names(rest)):
        columns[name] = _stored_or(part, name, part.sh[:, 1 + index % bands, index // bands])
    for axis, name in enumerate(SCALES):
        scale = part.scales[:, axis]
        columns[name] = encode_scale(scale)
        if name in part.stored:
            raw = part.stored[name]
            columns[name] = np.where(decode_scale(raw) == scale, raw, columns[name])
    columns["opacity"] = encode_opacity(part.opacities)
    if "opacity" in part.stored:
        raw = part.stored["opacity"]
        columns["opacity"] = np.where(decode_opacity(raw) == part.opacities, raw, columns["opacity"])
    quats: NDArray[Any] = part.quats
    if all(name in part.stored for name in QUATS):
        raw = np.stack([part.stored[name] for name in QUATS], axis=1)
        quats = np.where((decode_quats(raw) == quats).all(axis=1)[:, None], raw, quats)
    for axis, name in enumerate(QUATS):
        columns[name] = quats[:, axis]
    return columns


def _encode_mean(part: SplatCloud, name: str, axis: int) -> AnyArray:
    """Coordinates as the file has them: in double precision where the cloud has an offset."""
    means, offset = part.means[:, axis], part.offset[axis]
    if not part.offset.any():
        return _stored_or(part, name, means)
    whole: AnyArray = means.astype(np.float64) + offset
    if name in part.stored:
        raw = part.stored[name]
        return np.where((raw - offset).astype(np.float32) == means, raw, whole)
    return whole


def _stored_or(part: SplatCloud, name: str, values: FloatArray) -> AnyArray:
    """The stored column `name` where it rounds to `values`, else `values`."""
    if name not in part.stored:
        return values
    raw = part.stored[name]
    with np.errstate(over="ignore"):
        return np.where(raw.astype(np.float32) == values, raw, values)
