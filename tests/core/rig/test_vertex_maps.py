# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from proxy_meshes import grid, tube
from scipy.spatial.transform import Rotation

from gskin_addon.core.rig.vertex_maps import (
    COTANGENTS,
    FLAT,
    mesh_edges,
    mesh_neighbours,
    rest_rings,
    ring_maps,
    vertex_transforms,
)

EYE = np.eye(3)


def slow_map(verts, posed, faces, v, edges_only=False):
    """T_v of one vertex, edge by edge as the method notes have it, the normals as long as the ring has grown."""
    at = [(f, list(f).index(v)) for f in faces if v in f]
    lengths = [np.linalg.norm(verts[f[(k + o) % 3]] - verts[v]) for f, k in at for o in (1, 2)]
    s = np.mean(lengths)
    areas = [sum(np.linalg.norm(np.cross(x[f[1]] - x[f[0]], x[f[2]] - x[f[0]])) for f, _ in at) for x in (verts, posed)]
    grown = np.sqrt(areas[1] / areas[0])
    top, bottom = np.zeros((3, 3)), np.zeros((3, 3))
    normals = []
    for f, k in at:
        p, q = [verts[f[(k + o) % 3]] - verts[v] for o in (1, 2)]
        p2, q2 = [posed[f[(k + o) % 3]] - posed[v] for o in (1, 2)]
        for e, e2, apex, other in ((p, p2, f[(k + 2) % 3], f[(k + 1) % 3]), (q, q2, f[(k + 1) % 3], f[(k + 2) % 3])):
            a, b = verts[v] - verts[apex], verts[other] - verts[apex]
            c = np.clip(a @ b / np.linalg.norm(np.cross(a, b)), *COTANGENTS) / 2
            top += c * np.outer(e2, e)
            bottom += c * np.outer(e, e)
        normals.append([np.cross(x, y) / np.linalg.norm(np.cross(x, y)) for x, y in ((p, q), (p2, q2))])
    values = np.linalg.eigvalsh(bottom)
    if not edges_only or values[0] <= FLAT * values[2]:
        for n, n2 in normals:
            top += s**2 / len(at) * np.outer(grown * n2, n)
            bottom += s**2 / len(at) * np.outer(n, n)
    return top @ np.linalg.inv(bottom)


@pytest.mark.parametrize("edges_only", [False, True])
def test_fast_maps_equal_the_formula(edges_only):
    verts, faces = tube(rings=7, sides=6)
    rng = np.random.default_rng(0)
    verts = verts + rng.normal(0, 0.01, verts.shape)
    posed = verts + rng.normal(0, 0.03, verts.shape)
    maps = ring_maps(posed, faces, rest_rings(verts, faces, edges_only=edges_only))
    for v in range(len(verts)):
        np.testing.assert_allclose(maps[v], slow_map(verts, posed, faces, v, edges_only), atol=1e-10)


def closed(rings=9, sides=8):
    """A tube with both ends closed."""
    verts, faces = tube(rings=rings, sides=sides)
    ends = np.array([[0.0, 0, 0], verts[-sides:].mean(0)])
    k = np.arange(sides)
    n, last = len(verts), len(verts) - sides
    caps = [np.stack([np.full(sides, n), k, (k + 1) % sides], 1)]
    caps.append(np.stack([np.full(sides, n + 1), last + (k + 1) % sides, last + k], 1))
    return np.concatenate([verts, ends]), np.concatenate([faces, *caps])


@pytest.mark.parametrize("size", [1.5, 0.01, 40.0])
@pytest.mark.parametrize("edges_only", [False, True])
def test_a_mesh_of_another_size_is_that_size_in_all_directions(size, edges_only):
    """Its splats were 1.5, 1.5, 1.0 as large when the normals kept their length."""
    for verts, faces in (tube(), grid(), closed(), (np.eye(3), np.array([[0, 1, 2]]))):
        turn = Rotation.random(random_state=4).as_matrix()
        rotation, shear = vertex_transforms(verts, size * verts @ turn.T, faces, edges_only=edges_only)
        np.testing.assert_allclose(rotation, np.broadcast_to(turn, rotation.shape), atol=1e-9)
        np.testing.assert_allclose(shear / size, np.broadcast_to(EYE, shear.shape), atol=1e-9)


def test_edges_alone_give_a_linear_map_exactly_where_the_ring_is_not_flat():
    """What the normals add is a compromise there; Eq. 5's least squares has no error."""
    verts, faces = closed()
    verts = verts + np.random.default_rng(2).normal(0, 0.02, verts.shape)
    linear = np.array([[1.4, 0.3, 0.0], [0.1, 0.8, 0.2], [0.0, -0.2, 1.2]])
    exact = ring_maps(verts @ linear.T, faces, rest_rings(verts, faces, edges_only=True))
    np.testing.assert_allclose(exact, np.broadcast_to(linear, exact.shape), atol=1e-9)
    mixed = ring_maps(verts @ linear.T, faces, rest_rings(verts, faces))
    assert 0.02 < np.abs(mixed - linear).max() < 0.8


def test_rigid_motion_is_a_rotation_without_shear():
    for verts, faces in (tube(), grid(), (np.eye(3), np.array([[0, 1, 2]]))):
        turn = Rotation.random(random_state=3).as_matrix()
        rotation, shear = vertex_transforms(verts, verts @ turn.T + (1, 2, 3), faces)
        np.testing.assert_allclose(rotation, np.broadcast_to(turn, rotation.shape), atol=1e-10)
        np.testing.assert_allclose(shear, np.broadcast_to(EYE, shear.shape), atol=1e-10)


def test_stretch_and_shear_of_a_sheet_are_found_exactly():
    verts, faces = grid()
    for inplane in ([[2, 0], [0, 0.5]], [[1, 0.7], [0, 1]]):
        linear = EYE.copy()
        linear[:2, :2] = inplane
        rotation, shear = vertex_transforms(verts, verts @ linear.T, faces)
        np.testing.assert_allclose(rotation @ shear, np.broadcast_to(linear, shear.shape), atol=1e-12)
        np.testing.assert_allclose(shear, shear.transpose(0, 2, 1), atol=0)
        np.testing.assert_allclose(np.linalg.det(rotation), 1)
        assert np.linalg.eigvalsh(shear).min() > 0
    linear = np.array([[2.0, 0, 0], [0, 0.5, 0], [0, 0, 1]])
    rotation, shear = vertex_transforms(verts, verts @ linear.T, faces)
    np.testing.assert_allclose(rotation, np.broadcast_to(EYE, rotation.shape), atol=1e-12)


def test_scale_and_winding_do_not_matter():
    verts, faces = tube()
    posed = verts + np.random.default_rng(1).normal(0, 0.01, verts.shape)
    wanted = vertex_transforms(verts, posed, faces)
    flipped = faces.copy()
    flipped[::3] = flipped[::3, ::-1]
    for other in (vertex_transforms(verts * 1e3, posed * 1e3, faces), vertex_transforms(verts, posed, flipped)):
        for a, b in zip(wanted, other, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-7)


def test_three_faces_at_an_edge_loose_vertices_and_slivers():
    verts = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 1], [9, 9, 9], [0.5, 1e-9, 0]])
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 1, 6]])
    turn = Rotation.from_rotvec([0.3, 0.2, -1]).as_matrix()
    rotation, shear = vertex_transforms(verts, verts @ turn.T, faces)
    np.testing.assert_allclose(rotation[:5], np.broadcast_to(turn, (5, 3, 3)), atol=1e-10)
    np.testing.assert_array_equal(rotation[5:], [EYE, EYE])
    np.testing.assert_allclose(shear, np.broadcast_to(EYE, shear.shape), atol=1e-10)


def test_a_collapsed_pose_gives_finite_rotations():
    verts, faces = tube(rings=5, sides=5)
    rotation, shear = vertex_transforms(verts, np.zeros_like(verts), faces)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    np.testing.assert_array_equal(shear, 0)


def test_neighbours_are_those_along_edges():
    verts, faces = grid(4)
    table = mesh_neighbours(len(verts), faces)
    edges = {tuple(edge) for edge in mesh_edges(faces).tolist()}
    found = {tuple(sorted((v, n))) for v, row in enumerate(table.tolist()) for n in row if n != v}
    assert found == edges
    assert len(edges) == 33  # 12 across, 12 along, 9 diagonals
    assert mesh_neighbours(len(verts) + 1, faces, most=2).shape == (len(verts) + 1, 2)
    assert (mesh_neighbours(len(verts) + 1, faces)[-1] == len(verts)).all()
