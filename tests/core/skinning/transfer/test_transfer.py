# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from shape to shape: matches against brute force, inpainting where a match cannot be meant."""

from __future__ import annotations

import numpy as np
import pytest
from proxy_meshes import tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.triangles import closest_barycentric
from gskin_addon.core.skinning.transfer.facing import splat_facing, vertex_facing
from gskin_addon.core.skinning.transfer.match import agree, among_points, on_surface
from gskin_addon.core.skinning.transfer.transfer import Shape, transfer
from gskin_addon.core.splats.from_mesh import sample_mesh


def two_limbs(gap: float = 0.12):
    """An arm beside a leg, both closed tubes along x, `gap` apart; weights (V, 2): each of its own bone."""
    verts, faces = tube(2, 41, 16, 0.2)
    verts[:16, 1:] = verts[-16:, 1:] = 0  # closed ends
    both = np.concatenate([verts, verts + [0, 0.4 + gap, 0]])
    weights = np.zeros((len(both), 2), np.float32)
    weights[: len(verts), 0] = weights[len(verts) :, 1] = 1
    return both, np.concatenate([faces, faces + len(verts)]), weights


def sampled(verts, faces, weights, count=4000, seed=0):
    """Splats on a mesh and their weights."""
    rng = np.random.default_rng(seed)
    cloud, face, bary = sample_mesh(verts, faces, np.full((len(faces), 3, 3), 0.5), count, rng, below=0.0)
    return cloud, np.einsum("nk,nkb->nb", bary, weights[faces[face]]).astype(np.float32)


@pytest.fixture(scope="module")
def limbs():
    verts, faces, weights = two_limbs()
    cloud, truth = sampled(verts, faces, weights)
    return verts, faces, weights, Shape.of_splats(cloud), truth


def test_surface_matches_are_those_of_brute_force():
    rng = np.random.default_rng(1)
    verts, faces = tube(1, 9, 7, 0.2)
    weights = rng.random((len(verts), 3)).astype(np.float32)
    weights[:5] = 0  # a part that nobody weighted
    points = rng.normal(0, 0.5, (60, 3))
    facing = rng.normal(size=(60, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    out = vertex_facing(verts, faces)
    found = on_surface(points, facing, verts, faces, out, weights, reach=0.3, angle=70)
    diagonal = np.linalg.norm(np.ptp(verts, axis=0))
    for n, point in enumerate(points):
        bary = closest_barycentric(np.broadcast_to(point, (len(faces), 3)), verts[faces])
        away = np.linalg.norm(np.einsum("fk,fkd->fd", bary, verts[faces]) - point, axis=1)
        best = away.argmin()
        mean = bary[best] @ weights[faces[best]]
        if mean.sum() > 1e-3:
            np.testing.assert_allclose(found.weights[n], mean / mean.sum(), atol=1e-4)
        normal = bary[best] @ out[faces[best]]
        turned = np.degrees(np.arccos(np.clip(facing[n] @ normal / np.linalg.norm(normal), -1, 1)))
        far = away[best] / diagonal
        allowed = 70 + 50 * max(0, 1 - far / 0.01)
        if abs(turned - allowed) > 0.1 and not 1e-7 < mean.sum() < 1e-3:
            assert found.sure[n] == (far <= 0.3 and turned <= allowed and mean.sum() > 1e-6)


def test_matches_among_splats_are_those_of_brute_force():
    rng = np.random.default_rng(2)
    others, points = rng.random((80, 3)), rng.random((50, 3))
    facing, other_facing = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 80, 3)))
    weights = rng.random((80, 4)).astype(np.float32)
    weights[rng.random(80) < 0.2] = 0
    found = among_points(points, facing[:50], others, other_facing, weights, reach=0.15, angle=80, nearest=5)
    diagonal = np.linalg.norm(np.ptp(others, axis=0))
    for n, point in enumerate(points):
        away = np.linalg.norm(others - point, axis=1)
        near = np.argsort(away)[:5]
        turned = np.degrees(np.arccos(np.clip(other_facing[near] @ facing[n], -1, 1)))
        allowed = 80 + 40 * np.clip(1 - away[near] / diagonal / 0.01, 0, 1)
        good = (away[near] <= 0.15 * diagonal) & (turned <= allowed) & (weights[near].sum(1) > 0)
        assert found.sure[n] == good.any()
        pull = 1 / (away[near] ** 2 + (0.1 * away[near].max()) ** 2)
        mean = (pull * (good if good.any() else 1)) @ weights[near]
        np.testing.assert_allclose(found.weights[n], mean / mean.sum(), atol=1e-4)


def test_directions_of_unknown_sign_agree_with_their_opposites():
    up = np.array([[0, 0, 1.0]])
    assert agree(up, up, 45)
    assert not agree(up, -up, 45)
    assert agree(0.1 * up, -up, 45)
    assert agree(0 * up, -up, 45)
    assert not agree(0.1 * up, np.array([[1.0, 0, 0]]), 45)


def test_splats_face_as_the_mesh_that_they_were_sampled_from():
    verts, faces, weights = two_limbs(0.5)
    cloud, _ = sampled(verts, faces, weights)
    facing = splat_facing(cloud)
    out = cloud.means - np.where(cloud.means[:, 1:2] > 0.45, [[0, 0.9, 0]], 0)
    out[:, 0] = 0
    cosine = np.einsum("nk,nk->n", facing, out / np.linalg.norm(out, axis=1, keepdims=True))
    middle = np.abs(cloud.means[:, 0] - verts[:, 0].mean()) < 0.8
    assert np.median(cosine[middle]) > 0.9
    assert (cosine[middle] > 0.3).mean() > 0.97


def test_a_mesh_wound_inside_out_faces_out_all_the_same():
    verts, faces = tube(1, 9, 7, 0.2)
    np.testing.assert_allclose(vertex_facing(verts, faces[:, ::-1]), vertex_facing(verts, faces), atol=1e-9)


def test_on_the_mesh_itself_weights_are_the_truth(limbs):
    verts, faces, weights, target, truth = limbs
    result = transfer(Shape.of_mesh(verts, faces), weights, target)
    np.testing.assert_allclose(result.weights.sum(1), 1, atol=1e-5)
    assert np.abs(result.weights - truth).sum(1).mean() < 0.005
    assert result.taken.mean() > 0.95


def test_a_piece_that_is_wound_inside_out_is_matched_all_the_same(limbs):
    """As mirrored parts of game figures are; before, all of it was filled in from elsewhere."""
    verts, faces, weights, target, truth = limbs
    turned = faces.copy()
    leg = (faces >= len(verts) // 2).all(1)
    turned[leg] = faces[leg][:, ::-1]
    result = transfer(Shape.of_mesh(verts, turned), weights, target)
    assert result.taken.mean() > 0.95
    assert np.abs(result.weights - truth).sum(1).mean() < 0.005


def test_a_shifted_mesh_is_mended_by_inpainting(limbs):
    """The leg's near side lies closer to the arm than to itself: it faces the other way, so it is inpainted."""
    verts, faces, weights, target, truth = limbs
    source = Shape.of_mesh(verts + [0, 0.09, 0], faces)
    plain = transfer(source, weights, target, inpaint=False)
    better = transfer(source, weights, target)
    wrong = [np.abs(each.weights - truth).sum(1) > 0.5 for each in (plain, better)]
    assert wrong[0].sum() > 20
    assert wrong[1].sum() <= 0.1 * wrong[0].sum()
    assert better.weights.min() >= 0
    np.testing.assert_allclose(better.weights.sum(1), 1, atol=1e-5)


def test_another_sampling_of_the_same_body(limbs):
    verts, faces, weights, target, truth = limbs
    other, its = sampled(verts, faces, weights, 2500, seed=7)
    result = transfer(Shape.of_splats(other), its, target)
    assert np.abs(result.weights - truth).sum(1).mean() < 0.02
    assert (result.weights.argmax(1) == truth.argmax(1)).mean() > 0.99


def test_a_part_without_weights_is_filled_from_around_it(limbs):
    verts, faces, weights, target, truth = limbs
    some = weights.copy()
    middle = np.abs(verts[:, 0] - verts[:, 0].mean()) < 0.2
    some[middle] = 0
    result = transfer(Shape.of_mesh(verts, faces), some, target)
    assert not result.taken.all()
    assert (result.weights.argmax(1) == truth.argmax(1)).mean() > 0.98


def test_splats_give_a_mesh_its_weights_and_seams_stay_closed(limbs):
    verts, faces, weights, source, truth = limbs
    # Every triangle with vertices of its own, as files with hard edges have them.
    loose, alone = verts[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    result = transfer(source, truth, Shape.of_mesh(loose, alone))
    expected = weights[faces].reshape(-1, 2)
    assert np.abs(result.weights - expected).sum(1).mean() < 0.05
    place = np.unique(loose, axis=0, return_inverse=True)[1].reshape(-1)
    low, high = np.full((place.max() + 1, 2), 2.0), np.zeros((place.max() + 1, 2))
    np.minimum.at(low, place, result.weights)
    np.maximum.at(high, place, result.weights)
    assert (high - low).max() < 0.02


def test_what_nothing_holds_follows_the_nearest(limbs):
    """A limb that the source does not have at all, too far off to match."""
    verts, faces, weights, target, _ = limbs
    arm = faces[(faces < len(verts) // 2).all(1)]
    far = Shape(
        np.concatenate([target.points, target.points[:50] + [0, 0, 5]]),
        np.concatenate([target.facing, target.facing[:50]]),
    )
    result = transfer(Shape.of_mesh(verts[: len(verts) // 2], arm), weights[: len(verts) // 2], far)
    assert not result.taken[-50:].any()
    np.testing.assert_allclose(result.weights.sum(1), 1, atol=1e-5)


def test_a_source_elsewhere_or_without_weights_is_refused(limbs):
    verts, faces, weights, target, _ = limbs
    with pytest.raises(InputError, match="same place"):
        transfer(Shape.of_mesh(verts + 50, faces), weights, target)
    with pytest.raises(InputError, match="no weights"):
        transfer(Shape.of_mesh(verts, faces), 0 * weights, target)


def similar(angle=0.06, scale=1.03, move=(0.05, -0.04, 0.03)):
    """A small turn about an oblique axis, a scale and a move; matrix (4, 4)."""
    axis = np.array([0.3, -0.5, 0.8])
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    out = np.eye(4)
    out[:3, :3] = scale * (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
    out[:3, 3] = move
    return out


def bump():
    """A body without symmetry: an ellipsoid with a nose; verts and faces."""
    verts, faces = tube(1, 41, 40, 1.0)
    along = np.sin(np.pi * verts[:, 0])
    verts = np.stack([-np.cos(np.pi * verts[:, 0]), 0.6 * along * verts[:, 1], 0.4 * along * verts[:, 2]], axis=1)
    verts += 0.5 * np.exp(-8 * np.square(verts - [0.5, 0.4, 0.3]).sum(1, keepdims=True)) * [0.2, 1.0, 0.6]
    return verts, faces


@pytest.mark.parametrize("of", ["mesh", "splats"])
def test_a_shape_that_is_a_little_off_is_brought_back(of):
    verts, faces = bump()
    weights = np.stack([verts[:, 0] < 0, verts[:, 0] >= 0], axis=1).astype(np.float32)
    target = Shape.of_splats(sampled(verts, faces, weights, 4000)[0])
    moved = similar()
    off = verts @ moved[:3, :3].T + moved[:3, 3]
    source = Shape.of_mesh(off, faces)
    if of == "splats":
        source = Shape.of_splats(sampled(off, faces, weights, 3000, seed=5)[0])
    found = source.fitted(target, 0.2)
    back = np.linalg.inv(moved)
    expected = source.points @ back[:3, :3].T + back[:3, 3]
    assert np.linalg.norm(found.points - expected, axis=1).max() < 0.012
    assert np.linalg.norm(source.points - expected, axis=1).max() > 0.08
    np.testing.assert_allclose(np.linalg.norm(found.facing, axis=1), np.linalg.norm(source.facing, axis=1), atol=1e-6)


def test_a_fit_leaves_alone_what_lies_right_or_far_off():
    verts, faces = bump()
    weights = np.ones((len(verts), 1), np.float32)
    target = Shape.of_splats(sampled(verts, faces, weights, 4000)[0])
    source = Shape.of_mesh(verts, faces)
    assert np.abs(source.fitted(target, 0.05).points - verts).max() < 0.008
    far = Shape.of_mesh(verts + 100, faces)
    assert np.array_equal(far.fitted(target, 0.05).points, far.points)


def test_fitting_first_gives_the_weights_of_the_right_place(limbs):
    verts, faces, weights, target, truth = limbs
    source = Shape.of_mesh(verts + [0.05, 0.09, 0.02], faces)
    result = transfer(source, weights, target, fit=True)
    assert np.abs(result.weights - truth).sum(1).mean() < 0.01
