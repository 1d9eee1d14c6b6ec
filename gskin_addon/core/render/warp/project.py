# SPDX-License-Identifier: GPL-3.0-or-later
"""Warp kernels that take splats of many images to the image plane, and gradients back; see cpu/project.py.

The same arithmetic as the CPU's, in float64: a few hundred operations per splat, which even a GPU without fast
float64 has time for. Images of a batch (P) have one size; a camera is a row of `cpu.camera_vector`.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # no banner: a worker's output belongs to the job
wp.set_module_options({"enable_backward": False})

mat23d = wp.types.matrix(shape=(2, 3), dtype=wp.float64)
sums6 = wp.types.vector(length=6, dtype=wp.float32)
"""Sums over pixels of v, v dx, v dy, v dx^2, v dx dy, v dy^2; see cpu/project.py: project_backward."""

double = wp.float64
Cameras = wp.array2d(dtype=wp.float64)
Floats, Ints, Longs = wp.array(dtype=wp.float32), wp.array(dtype=wp.int32), wp.array(dtype=wp.int64)
Vec3s, Vec4s = wp.array(dtype=wp.vec3), wp.array(dtype=wp.vec4)
Vec2ds, Vec4is = wp.array(dtype=wp.vec2d), wp.array(dtype=wp.vec4i)
Sums = wp.array(dtype=sums6)

TILE = 16
"""Pixels along the side of a tile: one warp of 32 threads has eight pixels each."""

_CUT = wp.constant(wp.float32(1.0 / 255.0))
_CUT_D = wp.constant(wp.float64(1.0 / 255.0))
_TILE = wp.constant(TILE)


@wp.func
def camera_rotation(cameras: Cameras, p: int):
    """World to camera axes."""
    return wp.mat33d(
        cameras[p, 0], cameras[p, 1], cameras[p, 2], cameras[p, 3], cameras[p, 4], cameras[p, 5], cameras[p, 6],
        cameras[p, 7], cameras[p, 8],
    )  # fmt: skip


@wp.func
def camera_point(mean: wp.vec3, cameras: Cameras, p: int):
    """The mean in camera axes."""
    here = wp.vec3d(double(mean[0]), double(mean[1]), double(mean[2]))
    return camera_rotation(cameras, p) @ here + wp.vec3d(cameras[p, 9], cameras[p, 10], cameras[p, 11])


@wp.func
def unit_quat(quat: wp.vec4):
    """(unit quaternion wxyz, 1 / the norm it had; 0 if it cannot be normalised)."""
    q = wp.vec4d(double(quat[0]), double(quat[1]), double(quat[2]), double(quat[3]))
    norm = wp.length(q)
    inverse = double(0.0)
    if norm > double(0.0):
        inverse = double(1.0) / norm
    return q * inverse, inverse


@wp.func
def rotation(q: wp.vec4d):
    """Rotation matrix of a unit quaternion wxyz."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    one = double(1.0)
    two = double(2.0)
    return wp.mat33d(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@wp.func
def slopes(point: wp.vec3d, cameras: Cameras, p: int):
    """(x / z, y / z), clamped to a little beyond the image: for the Jacobian only, as INRIA and gsplat do."""
    iz = double(1.0) / point[2]
    u = wp.clamp(point[0] * iz, cameras[p, 16], cameras[p, 17])
    v = wp.clamp(point[1] * iz, cameras[p, 18], cameras[p, 19])
    return u, v


@wp.func
def jacobian(point: wp.vec3d, u: wp.float64, v: wp.float64, cameras: Cameras, p: int):
    """T = J W: how world directions at the mean move pixels."""
    iz = double(1.0) / point[2]
    fx = cameras[p, 12] * iz
    fy = cameras[p, 13] * iz
    none = double(0.0)
    J = mat23d(fx, none, -fx * u, none, fy, -fy * v)
    return J @ camera_rotation(cameras, p)


@wp.func
def covariance_factor(T: mat23d, R: wp.mat33d, scale: wp.vec3):
    """U = T R diag(s), whose square is the image covariance."""
    U = T @ R
    s0 = double(scale[0])
    s1 = double(scale[1])
    s2 = double(scale[2])
    return mat23d(U[0, 0] * s0, U[0, 1] * s1, U[0, 2] * s2, U[1, 0] * s0, U[1, 1] * s1, U[1, 2] * s2)


@wp.func
def covariance(U: mat23d, dilation: wp.float64):
    """(xx, xy, yy, determinant) of U U^T + dilation; the determinant as a sum without cancellation."""
    a = wp.vec3d(U[0, 0], U[0, 1], U[0, 2])
    b = wp.vec3d(U[1, 0], U[1, 1], U[1, 2])
    xx = wp.dot(a, a)
    xy = wp.dot(a, b)
    yy = wp.dot(b, b)
    m = wp.cross(a, b)
    det = wp.dot(m, m) + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, det


@wp.kernel
def project(
    splats: int, means: Vec3s, quats: Vec4s, scales: Vec3s, opacities: Floats, cameras: Cameras, width: int,
    height: int, pixels: Vec2ds, conic: Vec4s, reach: Floats, depth: Floats, rect: Vec4is, tiles: Longs,
) -> None:  # fmt: skip
    """Per image and splat (P*N,): pixel, conic (A, B, C, K), rows reached, depth, tile rectangle and tile count.

    ln(alpha) = K - A dx^2 - B dx dy - C dy^2 around the pixel; `tiles` is 0 for a splat that shows nowhere, whose
    other values are not written.
    """
    e = wp.tid()
    p = e // splats
    i = e - p * splats
    tiles[e] = wp.int64(0)
    if not (opacities[i] >= _CUT):
        return
    point = camera_point(means[e], cameras, p)
    q, inverse = unit_quat(quats[e])
    z = point[2]
    if not (z > cameras[p, 14]) or inverse == double(0.0):
        return
    u, v = slopes(point, cameras, p)
    U = covariance_factor(jacobian(point, u, v, cameras, p), rotation(q), scales[i])
    xx, xy, yy, det = covariance(U, cameras[p, 20])
    if not (det > double(0.0) and wp.isfinite(det)):
        return
    opacity = double(opacities[i])
    if cameras[p, 21] >= double(0.0):
        _xx, _xy, _yy, edet = covariance(U, cameras[p, 21])
        opacity = opacity * wp.sqrt(edet / det)
        if opacity < _CUT_D:
            return
    mx = cameras[p, 12] * point[0] / z + cameras[p, 22]
    my = cameras[p, 13] * point[1] / z + cameras[p, 23]
    square = double(2.0) * wp.log(double(255.0) * opacity)
    rx = wp.sqrt(square * xx)
    ry = wp.sqrt(square * yy)
    left = wp.max(wp.ceil(mx - rx - double(0.501)), double(0.0))
    right = wp.min(wp.floor(mx + rx - double(0.499)), double(width - 1))
    top = wp.max(wp.ceil(my - ry - double(0.501)), double(0.0))
    bottom = wp.min(wp.floor(my + ry - double(0.499)), double(height - 1))
    if not (left <= right and top <= bottom):
        return
    box = wp.vec4i(int(left) // _TILE, int(right) // _TILE + 1, int(top) // _TILE, int(bottom) // _TILE + 1)
    rect[e] = box
    tiles[e] = wp.int64((box[1] - box[0]) * (box[3] - box[2]))
    depth[e] = wp.float32(z)
    half = double(0.5) / det
    pixels[e] = wp.vec2d(mx, my)
    conic[e] = wp.vec4(
        wp.float32(yy * half), wp.float32(double(-2.0) * xy * half), wp.float32(xx * half), wp.float32(wp.log(opacity))
    )
    reach[e] = wp.float32(ry) + 0.001


@wp.func
def quat_gradient(G: wp.mat33d, q: wp.vec4d, inverse: wp.float64):
    """From G = dL/dR to the gradient to the quaternion that was normalised to q (`inverse` = 1 / its norm)."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    two = double(2.0)
    g = wp.vec4d(
        two * (z * (G[1, 0] - G[0, 1]) + y * (G[0, 2] - G[2, 0]) + x * (G[2, 1] - G[1, 2])),
        two * (y * (G[0, 1] + G[1, 0]) + z * (G[0, 2] + G[2, 0]) + w * (G[2, 1] - G[1, 2])
               - two * x * (G[1, 1] + G[2, 2])),
        two * (x * (G[0, 1] + G[1, 0]) + z * (G[1, 2] + G[2, 1]) + w * (G[0, 2] - G[2, 0])
               - two * y * (G[0, 0] + G[2, 2])),
        two * (x * (G[0, 2] + G[2, 0]) + y * (G[1, 2] + G[2, 1]) + w * (G[1, 0] - G[0, 1])
               - two * z * (G[0, 0] + G[1, 1])),
    )  # fmt: skip
    return (g - wp.dot(g, q) * q) * inverse


@wp.kernel
def project_backward(
    splats: int, means: Vec3s, quats: Vec4s, scales: Vec3s, cameras: Cameras, last_slot: Longs, tiles: Longs,
    partial: Sums, grad_means: Vec3s, grad_quats: Vec4s,
) -> None:  # fmt: skip
    """Gradients (P*N,) to means and quats from the sums of every (splat, tile) pair, added in a fixed order."""
    e = wp.tid()
    p = e // splats
    i = e - p * splats
    g0 = double(0.0)
    g1 = double(0.0)
    g2 = double(0.0)
    g3 = double(0.0)
    g4 = double(0.0)
    g5 = double(0.0)
    for slot in range(int(last_slot[e] - tiles[e]), int(last_slot[e])):
        s = partial[slot]
        g0 += double(s[0])
        g1 += double(s[1])
        g2 += double(s[2])
        g3 += double(s[3])
        g4 += double(s[4])
        g5 += double(s[5])
    none = double(0.0)
    if g0 == none and g1 == none and g2 == none and g3 == none and g4 == none and g5 == none:
        grad_means[e] = wp.vec3(0.0, 0.0, 0.0)
        grad_quats[e] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        return
    half = double(0.5)
    point = camera_point(means[e], cameras, p)
    q, inverse = unit_quat(quats[e])
    u, v = slopes(point, cameras, p)
    R = rotation(q)
    W = camera_rotation(cameras, p)
    T = jacobian(point, u, v, cameras, p)
    U = covariance_factor(T, R, scales[i])
    xx, xy, yy, det = covariance(U, cameras[p, 20])
    a = yy / det
    b = -xy / det
    c = xx / det
    # ln alpha = ln o - (a dx^2 + 2 b dx dy + c dy^2) / 2; H = dL/dS = inverse (sum v d d^T) inverse / 2
    gx = a * g1 + b * g2
    gy = b * g1 + c * g2
    px = a * g3 + b * g4
    py = a * g4 + b * g5
    qx = b * g3 + c * g4
    qy = b * g4 + c * g5
    hxx = half * (px * a + py * b)
    hxy = half * (px * b + py * c)
    hyy = half * (qx * b + qy * c)
    if cameras[p, 21] >= none:
        exx, exy, eyy, edet = covariance(U, cameras[p, 21])
        if edet > none:
            # d ln sqrt(det(S + e) / det(S + dilation)) / dS
            hxx = hxx + half * g0 * (eyy / edet - a)
            hxy = hxy + half * g0 * (-exy / edet - b)
            hyy = hyy + half * g0 * (exx / edet - c)
    # D = dL/d(T R) = 2 H U diag(s)
    H = wp.mat22d(hxx, hxy, hxy, hyy)
    HU = H @ U
    s0 = double(2.0) * double(scales[i][0])
    s1 = double(2.0) * double(scales[i][1])
    s2 = double(2.0) * double(scales[i][2])
    D = mat23d(HU[0, 0] * s0, HU[0, 1] * s1, HU[0, 2] * s2, HU[1, 0] * s0, HU[1, 1] * s1, HU[1, 2] * s2)
    gq = quat_gradient(wp.transpose(T) @ D, q, inverse)
    # dL/dJ = dL/dT W^T with dL/dT = D R^T
    dJ = D @ wp.transpose(R) @ wp.transpose(W)
    iz = double(1.0) / point[2]
    fx = cameras[p, 12] * iz
    fy = cameras[p, 13] * iz
    dx = fx * gx
    dy = fy * gy
    dz = -iz * (
        dx * point[0] + dy * point[1] + fx * dJ[0, 0] + fy * dJ[1, 1] - fx * u * dJ[0, 2] - fy * v * dJ[1, 2]
    )
    if point[0] * iz == u:  # the slope was not clamped
        dx = dx - fx * iz * dJ[0, 2]
        dz = dz + fx * iz * u * dJ[0, 2]
    if point[1] * iz == v:
        dy = dy - fy * iz * dJ[1, 2]
        dz = dz + fy * iz * v * dJ[1, 2]
    gm = wp.transpose(W) @ wp.vec3d(dx, dy, dz)
    grad_means[e] = wp.vec3(wp.float32(gm[0]), wp.float32(gm[1]), wp.float32(gm[2]))
    grad_quats[e] = wp.vec4(wp.float32(gq[0]), wp.float32(gq[1]), wp.float32(gq[2]), wp.float32(gq[3]))
