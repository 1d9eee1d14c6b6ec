# SPDX-License-Identifier: GPL-3.0-or-later
"""Attributes of KHR_gaussian_splatting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import splat_clouds as clouds
from glb import decode_attributes

from gskin_addon.core.splats import gltf


@pytest.mark.parametrize("degree", range(5))
def test_names_shapes_and_order(degree):
    cloud = clouds.random_cloud(7, degree)
    attributes = gltf.encode_attributes(cloud)
    prefix = "KHR_gaussian_splatting:"
    expected = {f"{prefix}ROTATION", f"{prefix}SCALE", f"{prefix}OPACITY"}
    for band in range(min(degree, 3) + 1):
        expected |= {f"{prefix}SH_DEGREE_{band}_COEF_{n}" for n in range(2 * band + 1)}
    assert set(attributes) == expected
    assert all(values.dtype == np.float32 and values.flags.c_contiguous for values in attributes.values())
    np.testing.assert_array_equal(attributes[f"{prefix}ROTATION"][:, 3], cloud.quats[:, 0])
    np.testing.assert_array_equal(attributes[f"{prefix}ROTATION"][:, :3], cloud.quats[:, 1:])
    if degree >= 2:
        np.testing.assert_array_equal(attributes[f"{prefix}SH_DEGREE_2_COEF_4"], cloud.sh[:, 8])


def test_decoding_gives_the_cloud_back():
    cloud = clouds.random_cloud(20, 3)
    again = decode_attributes(cloud.means, gltf.encode_attributes(cloud))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cloud, name))


def test_axes():
    np.testing.assert_array_equal(gltf.blender_to_gltf() @ [1, 2, 3], [1, 3, -2])


def test_fallback_colour_is_linear():
    cloud = clouds.random_cloud(3, 0)
    sh = np.zeros((3, 1, 3), np.float32)
    sh[0] = (0.5 - 0.5) / 0.28209479
    sh[1] = 10.0
    sh[2] = (0.02 - 0.5) / 0.28209479
    color = gltf.fallback_color(replace(cloud, sh=sh, opacities=[0.0, 0.5, 1.0])) / 65535.0
    np.testing.assert_allclose(color[:, 0], [0.21404114, 1.0, 0.02 / 12.92], atol=1e-5)
    np.testing.assert_allclose(color[:, 3], [0.0, 0.5, 1.0], atol=1e-5)
