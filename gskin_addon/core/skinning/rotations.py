# SPDX-License-Identifier: GPL-3.0-or-later
"""Closed-form closest rotation as a compiled kernel, for the as-rigid-as-possible energies.

Not imported by the package's numpy-only modules: numba is needed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def _cross4(a, b, c, out):  # type: ignore[no-untyped-def]
    """Vector orthogonal to three vectors of R^4; returns its squared length."""
    p, q, r = b[2] * c[3] - b[3] * c[2], b[1] * c[3] - b[3] * c[1], b[1] * c[2] - b[2] * c[1]
    s, t, u = b[0] * c[3] - b[3] * c[0], b[0] * c[2] - b[2] * c[0], b[0] * c[1] - b[1] * c[0]
    out[0] = a[1] * p - a[2] * q + a[3] * r
    out[1] = -(a[0] * p - a[2] * s + a[3] * t)
    out[2] = a[0] * q - a[1] * s + a[3] * u
    out[3] = -(a[0] * r - a[1] * t + a[2] * u)
    return out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2


@njit(cache=True)
def closest_rotation(S, R):  # type: ignore[no-untyped-def]
    """Write into R (3, 3) the rotation that maximises trace(R^T S), S = sum posed edge x rest edge^T.

    Horn's quaternion form: the eigenvector of a symmetric traceless 4x4 matrix K for its largest
    eigenvalue, which Newton finds on the characteristic polynomial from an upper bound (Theobald 2005).
    Always proper, also for flat neighbourhoods; the identity where S vanishes.
    """
    K = np.empty((4, 4))
    K[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    K[1, 1] = S[0, 0] - S[1, 1] - S[2, 2]
    K[2, 2] = S[1, 1] - S[0, 0] - S[2, 2]
    K[3, 3] = S[2, 2] - S[0, 0] - S[1, 1]
    K[0, 1] = K[1, 0] = S[2, 1] - S[1, 2]
    K[0, 2] = K[2, 0] = S[0, 2] - S[2, 0]
    K[0, 3] = K[3, 0] = S[1, 0] - S[0, 1]
    K[1, 2] = K[2, 1] = S[0, 1] + S[1, 0]
    K[1, 3] = K[3, 1] = S[0, 2] + S[2, 0]
    K[2, 3] = K[3, 2] = S[1, 2] + S[2, 1]
    # Scale to unit size: the polynomial's coefficients are fourth powers.
    norm = 0.0
    for i in range(3):
        for j in range(3):
            norm += S[i, j] ** 2
    R[:] = 0.0
    R[0, 0] = R[1, 1] = R[2, 2] = 1.0
    if norm < 1e-60:
        return
    K /= math.sqrt(norm)
    # Traces of K^2, K^3 and K^4 from the entries of the symmetric K^2; a library call for 4x4 costs more.
    p2, p3, p4 = 0.0, 0.0, 0.0
    for i in range(4):
        for j in range(i, 4):
            square = K[i, 0] * K[0, j] + K[i, 1] * K[1, j] + K[i, 2] * K[2, j] + K[i, 3] * K[3, j]
            twice = 1.0 if i == j else 2.0
            p2 += square if i == j else 0.0
            p3 += twice * square * K[i, j]
            p4 += twice * square * square
    c2, c1, c0 = -p2 / 2, -p3 / 3, p2 * p2 / 8 - p4 / 4  # Newton's identities, trace K = 0
    value = math.sqrt(3.0)  # sum of S's singular values is at most sqrt(3) |S|
    for _ in range(40):
        f = ((value * value + c2) * value + c1) * value + c0
        df = (4 * value * value + 2 * c2) * value + c1
        if df <= 1e-14:
            break
        step = f / df
        value -= step
        if abs(step) < 1e-14:
            break
    for i in range(4):
        K[i, i] -= value
    best, longest = np.zeros(4), 0.0
    vector = np.empty(4)
    for drop in range(4):
        length = _cross4(K[(drop + 1) % 4], K[(drop + 2) % 4], K[(drop + 3) % 4], vector)
        if length > longest:
            longest = length
            best[:] = vector
    if longest < 1e-24:
        return
    best /= math.sqrt(longest)
    w, x, y, z = best[0], best[1], best[2], best[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
