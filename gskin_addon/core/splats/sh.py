# SPDX-License-Identifier: GPL-3.0-or-later
"""Real spherical harmonics of degree 0-4 in the order and signs of the INRIA 3DGS renderer."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from .cloud import MAX_SH_DEGREE, SH_C0, FloatArray, Floats

_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
_C4 = (
    2.5033429417967046,
    -1.7701307697799304,
    0.9461746957575601,
    -0.6690465435572892,
    0.10578554691520431,
    -0.6690465435572892,
    0.47308734787878004,
    -1.7701307697799304,
    0.6258357354491761,
)
_CHUNK = 16384
"""Splats handled at once where a temporary is several times larger than the result."""


def sh_degree(coefficients: int) -> int:
    """Degree of a set of `coefficients` = (degree + 1)^2 harmonics; ValueError for other counts."""
    degree = round(coefficients**0.5) - 1
    if (degree + 1) ** 2 != coefficients or not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"{coefficients} spherical-harmonic coefficients are not whole bands of degree 0-4")
    return degree


def sh_basis(dirs: Floats, degree: int) -> Floats:
    """Values of the (degree + 1)^2 basis functions at unit directions (..., 3): (..., (degree + 1)^2).

    Polynomials of the INRIA renderer (degree 0-3) and of PlenOctrees (degree 4); same float type as `dirs`.
    """
    x, y, z = dirs[..., 0], dirs[..., 1], dirs[..., 2]
    basis = np.empty((*dirs.shape[:-1], (degree + 1) ** 2), dtype=dirs.dtype)
    basis[..., 0] = SH_C0
    if degree >= 1:
        basis[..., 1] = -_C1 * y
        basis[..., 2] = _C1 * z
        basis[..., 3] = -_C1 * x
    if degree >= 2:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        band = (xy, yz, 2.0 * zz - xx - yy, xz, xx - yy)
        for index, values in enumerate(band):
            basis[..., 4 + index] = _C2[index] * values
    if degree >= 3:
        band3 = (
            y * (3.0 * xx - yy),
            xy * z,
            y * (4.0 * zz - xx - yy),
            z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            x * (4.0 * zz - xx - yy),
            z * (xx - yy),
            x * (xx - 3.0 * yy),
        )
        for index, values in enumerate(band3):
            basis[..., 9 + index] = _C3[index] * values
    if degree >= 4:
        band4 = (
            xy * (xx - yy),
            yz * (3.0 * xx - yy),
            xy * (7.0 * zz - 1.0),
            yz * (7.0 * zz - 3.0),
            zz * (35.0 * zz - 30.0) + 3.0,
            xz * (7.0 * zz - 3.0),
            (xx - yy) * (7.0 * zz - 1.0),
            xz * (xx - 3.0 * yy),
            xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy),
        )
        for index, values in enumerate(band4):
            basis[..., 16 + index] = _C4[index] * values
    return basis


def basis_constants() -> tuple[float, ...]:
    """Factors of the 15 polynomials of degree 1-3, in the order of `sh_basis`, for who evaluates them elsewhere."""
    return (-_C1, _C1, -_C1, *_C2, *_C3)


def eval_sh(sh: FloatArray, dirs: FloatArray) -> FloatArray:
    """Colours (N, 3) of coefficients (N, K, 3) seen along unit directions (N, 3), camera to splat.

    max(0, 0.5 + sum_k sh_k Y_k(d)), as in the INRIA renderer.
    """
    degree = sh_degree(sh.shape[1])
    colors = np.empty((len(sh), 3), dtype=np.float32)
    for start in range(0, len(sh), _CHUNK):
        part = slice(start, start + _CHUNK)
        basis = sh_basis(np.asarray(dirs[part], dtype=np.float32), degree)
        colors[part] = np.matmul(basis[:, None, :], sh[part])[:, 0]
    colors += np.float32(0.5)
    return np.maximum(colors, np.float32(0.0), out=colors)


@cache
def _sample_directions(band: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (M, 3) on a Fibonacci spiral, and the (2 band + 1, M) fit of the band's values there."""
    count = 4 * band + 4
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = index * np.pi * (3.0 - 5.0**0.5)
    radius = np.sqrt(1.0 - z * z)
    dirs = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return dirs, np.linalg.pinv(sh_basis(dirs, band)[:, band * band :])


def sh_rotation(R: Floats, degree: int) -> list[NDArray[np.float64]]:
    """Matrices (..., 2l + 1, 2l + 1), one per band l = 1..degree, that turn coefficients by R (..., 3, 3).

    The turned function is f'(d) = f(R^T d). A band is closed under rotation, so its matrix follows exactly
    from the basis values at more than 2l + 1 directions (projection method; no recurrences).
    """
    matrices = []
    for band in range(1, degree + 1):
        dirs, fit = _sample_directions(band)
        turned = sh_basis(dirs @ np.asarray(R, dtype=np.float64), band)[..., band * band :]
        matrices.append(np.matmul(fit, turned))
    return matrices


def rotate_sh(sh: FloatArray, R: Floats) -> FloatArray:
    """Coefficients (N, K, 3) turned by one rotation (3, 3) or one per splat (N, 3, 3): f'(d) = f(R^T d)."""
    degree = sh_degree(sh.shape[1])
    turned = np.array(sh, dtype=np.float32)
    single = R.ndim == 2
    shared = sh_rotation(R, degree) if single else []
    for start in range(0, len(sh) if degree else 0, _CHUNK):
        part = slice(start, start + _CHUNK)
        matrices = shared if single else sh_rotation(R[part], degree)
        for band, matrix in enumerate(matrices, start=1):
            rows = slice(band * band, (band + 1) ** 2)
            turned[part, rows] = np.matmul(matrix.astype(np.float32), sh[part, rows])
    return turned
