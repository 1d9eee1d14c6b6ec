# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats as the vertex attributes of a glTF primitive (KHR_gaussian_splatting)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .axes import up_rotation
from .cloud import Floats, SplatCloud

EXTENSION_NAME = "KHR_gaussian_splatting"
MAX_GLTF_SH_DEGREE = 3
"""Harmonics of a higher degree have no attribute in the extension."""

EXTENSION: Mapping[str, str] = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
"""The extension object of the primitive: splats as trained by 3DGS programs, in display-referred sRGB."""

SKINNING_EXTRAS_NAME = "GSKIN_splat_skinning"
SKINNING_EXTRAS: Mapping[str, Any] = {
    "version": 2,
    "rotation": "weightedQuaternionSum",
    "signs": "strongestJoint",
    "scale": "localMap",
    "sphericalHarmonics": "rotateWithSplat",
}
"""In the primitive's extras: how the splats turn with the skin; `docs/gltf.md` defines each value."""


OFFSET_EXTRAS_NAME = "GSKIN_geo_offset"
"""In the primitive's extras: what must be added to positions for coordinates far from the origin, in glTF's axes."""


def blender_to_gltf() -> NDArray[np.float64]:
    """(3, 3) rotation from Blender's Z-up world to glTF's Y-up world: (x, y, z) -> (x, z, -y)."""
    return up_rotation("y").T


def sh_attribute(index: int) -> str:
    """Attribute name of spherical-harmonic coefficient `index` (0 = the constant one)."""
    degree = int(index**0.5)
    return f"{EXTENSION_NAME}:SH_DEGREE_{degree}_COEF_{index - degree * degree}"


def encode_attributes(cloud: SplatCloud) -> dict[str, Floats]:
    """The extension's vertex attributes of a cloud that is already in glTF's axes; float32, by name.

    ROTATION (N, 4) xyzw unit; SCALE (N, 3) linear; OPACITY (N,); SH_DEGREE_l_COEF_n (N, 3) each, l <= 3.
    POSITION is the centres themselves and not part of it.
    """
    attributes: dict[str, Floats] = {
        f"{EXTENSION_NAME}:ROTATION": np.ascontiguousarray(np.roll(cloud.quats, -1, axis=1)),
        f"{EXTENSION_NAME}:SCALE": np.ascontiguousarray(cloud.scales),
        f"{EXTENSION_NAME}:OPACITY": np.ascontiguousarray(cloud.opacities),
    }
    count = (min(cloud.sh_degree, MAX_GLTF_SH_DEGREE) + 1) ** 2
    for index in range(count):
        attributes[sh_attribute(index)] = np.ascontiguousarray(cloud.sh[:, index])
    return attributes


def fallback_color(cloud: SplatCloud) -> NDArray[np.uint16]:
    """COLOR_0 (N, 4) as normalised 16-bit: linear colour of the constant harmonic, and the opacity.

    For viewers that do not know the extension. Vertex colours are linear in glTF, the splats' are sRGB.
    """
    srgb = cloud.base_colors().astype(np.float64)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgba = np.concatenate([linear, np.clip(cloud.opacities[:, None], 0.0, 1.0)], axis=1)
    return np.round(rgba * 65535.0).astype(np.uint16)


def linear_to_srgb(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sRGB curve (IEC 61966-2-1), the other way than `fallback_color` goes; below 0 its straight part goes on."""
    curve = 1.055 * np.maximum(values, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(values <= 0.0031308, 12.92 * values, curve)
