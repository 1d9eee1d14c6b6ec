# SPDX-License-Identifier: GPL-3.0-or-later

import numpy as np
import pytest
from benchmark_bodies import capsule, capsule_asset, two_bones

from benchmarks.quality.methods import MethodInput, Unavailable, create_method
from benchmarks.quality.methods.base import complete, nearest_bone
from benchmarks.quality.methods.heat import weld
from benchmarks.quality.methods.job import job_settings


@pytest.fixture(scope="module")
def subject():
    asset = capsule_asset()
    return MethodInput(asset, asset.skeleton, asset.weights)


def test_bbw_of_a_bar_is_bounded_a_partition_of_unity_and_symmetric():
    pytest.importorskip("igl")
    from benchmarks.quality.methods.bbw import bounded_biharmonic, handles, interpolate, lattice

    solid = np.ones((20, 4, 4), bool)
    mesh = lattice(solid, np.array([0.0, -0.2, -0.2]), 0.1)
    edges = mesh.nodes[mesh.tets[:, 1:]] - mesh.nodes[mesh.tets[:, :1]]
    assert np.linalg.det(edges).min() > 0
    assert np.linalg.det(edges).sum() / 6 == pytest.approx(2.0 * 0.4 * 0.4)

    held = handles(mesh.nodes, two_bones(), 0.1)
    assert set(held) == {-1, 0, 1}
    weights = bounded_biharmonic(mesh, held, 2)
    assert weights.min() >= 0
    assert weights.max() <= 1
    assert np.allclose(weights.sum(axis=1), 1)
    assert (weights[held == 1] == (0, 1)).all()
    # Kuhn's tetrahedra have a direction, so the mirror image is close, not equal.
    points = np.random.default_rng(0).uniform((0, -0.2, -0.2), (2, 0.2, 0.2), (500, 3))
    there, mirrored = (interpolate(mesh, weights, p) for p in (points, points * (-1, 1, 1) + (2, 0, 0)))
    assert np.abs(there - mirrored[:, ::-1]).mean() < 0.01
    assert interpolate(mesh, weights, np.array([[0.2, 0.1, 0.1]]))[0, 0] > 0.95


def test_bbw_leaves_parts_without_bones_to_the_nearest_bone():
    pytest.importorskip("igl")
    from benchmarks.quality.methods.bbw import bounded_biharmonic, handles, lattice

    solid = np.zeros((20, 4, 12), bool)
    solid[:, :, :4] = True
    solid[:, :, 8:] = True
    mesh = lattice(solid, np.array([0.0, -0.2, -0.2]), 0.1)
    far = mesh.nodes[:, 2] > 0.3
    weights = bounded_biharmonic(mesh, handles(mesh.nodes, two_bones(), 0.1), 2)
    assert (weights[far] == 0).all()
    assert np.allclose(weights[~far].sum(axis=1), 1)
    whole, bare = complete(weights, mesh.nodes, two_bones())
    assert bare == far.sum()
    assert np.allclose(whole.sum(axis=1), 1)


@pytest.mark.parametrize("method", ["bbw", "heat_mesh", "heat_proxy", "nearest", "initial"])
def test_methods_bend_a_capsule_at_its_joint(subject, method):
    if method.startswith("heat"):
        pytest.importorskip("bpy")
    if method in ("bbw", "heat_proxy"):
        pytest.importorskip("igl")
    made = create_method(method).make(subject)
    x = subject.cloud.means[:, 0]
    assert made.weights.shape == subject.truth.shape
    assert not made.partly
    assert np.allclose(made.weights.sum(axis=1), 1, atol=1e-5)
    assert made.weights[x < 0.3, 0].mean() > 0.9
    assert made.weights[x > 1.7, 1].mean() > 0.9
    assert abs(made.weights[np.abs(x - 1) < 0.05].mean(axis=0)[0] - 0.5) < 0.1


def test_heat_on_a_capsule_whose_triangles_were_apart():
    pytest.importorskip("bpy")
    from benchmarks.quality.methods.heat import bone_heat

    verts, faces = capsule()
    corners = verts[faces].reshape(-1, 3)
    apart = np.arange(len(corners)).reshape(-1, 3)
    merged, triangles, new = weld(corners, apart)
    assert len(merged) == len(verts)
    assert len(triangles) == len(faces)
    assert np.allclose(merged[new], corners, atol=1e-4)
    weights, warning = bone_heat(merged, triangles, two_bones())
    assert warning == ""
    assert (weights.sum(axis=1) > 0.95).all()  # Blender drops small weights and does not normalise
    assert weights[merged[:, 0] < 0.3, 0].min() > 0.95
    assert weights[merged[:, 0] > 1.7, 1].min() > 0.95


def test_unreachable_parts_of_a_mesh_count_as_partly_failed(subject):
    pytest.importorskip("bpy")
    from dataclasses import replace

    verts, faces = capsule()
    # A second shell around the first: no bone sees it from inside the first one.
    surface = subject.surface
    verts, faces = np.concatenate([verts, verts * 1.4]), np.concatenate([faces, faces + len(verts)])
    twice = replace(surface, verts=verts, faces=faces)
    both = MethodInput(replace(subject.asset, surface=twice), subject.skeleton, None)
    made = create_method("heat_mesh").make(both)
    assert made.partly
    assert "follow their nearest bone" in made.note
    assert np.allclose(made.weights.sum(axis=1), 1, atol=1e-5)


def test_nearest_bone_and_rows_without_weights():
    points = np.array([[0.2, 0.1, 0], [1.6, 0.1, 0], [9.0, 0, 0]])
    assert nearest_bone(points, two_bones()).tolist() == [0, 1, 1]
    weights, bare = complete(np.array([[2.0, 2.0], [0, 0], [np.nan, 1.0]]), points, two_bones())
    assert bare == 1
    assert np.allclose(weights, [[0.5, 0.5], [0, 1], [0, 1]])


def test_names_of_jobs():
    assert job_settings("ours:default") == {}
    assert job_settings("ours:visibility+elastic@draft") == {
        "init": "visibility", "guidance": "elastic", "preset": "draft",
    }  # fmt: skip
    with pytest.raises(Unavailable, match="no guidance 'telepathy'"):
        job_settings("ours:visibility+telepathy")
    with pytest.raises(ValueError, match="ours:sideways"):
        job_settings("ours:sideways")
    with pytest.raises(ValueError, match="no method 'magic'"):
        create_method("magic")
