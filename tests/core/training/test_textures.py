# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from rigged_assets import write_tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.training.rigged import load_asset, read_rigged_mesh
from gskin_addon.core.training.textures import Textures, sample_image, to_linear, to_srgb


def picture():
    """Red grows to the right, green downwards, in 16 x 8 pixels."""
    rows, columns = np.mgrid[0:8, 0:16]
    return np.stack([columns * 17, rows * 36, 0 * rows], axis=-1).astype(np.uint8)


def test_a_picture_is_read_between_its_pixels_and_repeats():
    image = picture()
    centre = np.array([[(3 + 0.5) / 16, 1 - (2 + 0.5) / 8]])
    np.testing.assert_allclose(sample_image(image, centre), [[51 / 255, 72 / 255, 0]], atol=1e-12)
    between = centre + [[0.25 / 16, 0]]
    np.testing.assert_allclose(sample_image(image, between), [[(0.75 * 51 + 0.25 * 68) / 255, 72 / 255, 0]], atol=1e-12)
    np.testing.assert_allclose(sample_image(image, between + [[-3, 5]]), sample_image(image, between), atol=1e-12)
    lower_left = sample_image(image, np.array([[0.5 / 16, 0.5 / 8]]))
    np.testing.assert_allclose(lower_left, [[0, 252 / 255, 0]], atol=1e-12)


def test_srgb_and_linear_light_are_inverse():
    values = np.linspace(0, 1, 100)
    np.testing.assert_allclose(to_srgb(to_linear(values)), values, atol=1e-12)
    assert to_linear(np.array(0.5)) == pytest.approx(0.21404, abs=1e-5)


def test_only_triangles_with_a_texture_get_one_and_tints_multiply_light():
    uv = np.tile(np.array([[0.2, 0.3]]), (3, 3, 1))
    white = np.full((2, 2, 3), 255, np.uint8)
    tint = np.ones((3, 3, 3))
    tint[1] = 0.25
    textures = Textures(uv, np.array([0, 1, -1]), (picture(), white), tint)
    has, colors = textures.colors(np.array([0, 1, 2]), np.full((3, 3), 1 / 3))
    assert has.tolist() == [True, True, False]
    np.testing.assert_allclose(colors[0], sample_image(picture(), np.array([[0.2, 0.3]]))[0], atol=1e-9)
    np.testing.assert_allclose(colors[1], to_srgb(np.full(3, 0.25)), atol=1e-12)
    assert not colors[2].any()


def textured_tube(path, **changed):
    """A tube whose corners are all grey and whose texture is striped."""
    plain = dict(np.load(write_tube(path)))
    faces = plain["faces"]
    u = plain["verts"][faces][..., 0] / 3.0
    stripes = np.zeros((4, 60, 3), np.uint8)
    stripes[:, ::10] = stripes[:, 1::10] = stripes[:, 2::10] = 255
    arrays = {
        **plain,
        "corner_rgb": np.full((len(faces), 3, 3), 128, np.uint8),
        "corner_uv": np.stack([u, 0.5 + 0 * u], axis=-1).astype(np.float32),
        "face_texture": np.zeros(len(faces), np.int16),
        "texture_0": stripes,
        **changed,
    }
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_splats_have_the_textures_colours_not_only_the_corners(tmp_path):
    asset = load_asset(textured_tube(tmp_path / "striped.npz"), 3000)
    brightness = asset.cloud.base_colors().mean(axis=1)
    bary, face = asset.surface.bary, asset.surface.face
    u = np.einsum("nk,nk->n", bary, asset.surface.verts[asset.surface.faces[face]][..., 0]) / 3.0
    inside = (u * 60) % 10
    np.testing.assert_allclose(brightness[(inside > 0.6) & (inside < 2.4)], 1, atol=0.01)
    np.testing.assert_allclose(brightness[(inside > 3.6) & (inside < 9.4)], 0, atol=0.01)
    plain = load_asset(textured_tube(tmp_path / "grey.npz", face_texture=None), 3000)
    np.testing.assert_allclose(plain.cloud.base_colors(), 128 / 255, atol=0.01)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"texture_0": np.zeros((4, 4), np.uint8)}, "texture_0 is no picture"),
        ({"texture_0": np.zeros((0, 4, 3), np.uint8)}, "texture_0 is no picture"),
        ({"texture_0": np.zeros((4, 4, 3), np.float32)}, "texture_0 is no picture"),
        ({"texture_0": None}, "does not fit the faces and textures"),
        ({"corner_uv": np.zeros((2, 3, 2), np.float32)}, "does not fit the faces and textures"),
        ({"corner_tint": np.zeros((2, 3, 3), np.uint8)}, "corner_tint does not fit"),
    ],
)
def test_textures_that_do_not_fit_are_refused_by_name(tmp_path, changed, words):
    path = textured_tube(tmp_path / "bad.npz", **changed)
    with pytest.raises(InputError, match=f"The asset '{path}' is damaged .*{words}"):
        read_rigged_mesh(path)
