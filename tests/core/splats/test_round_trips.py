# SPDX-License-Identifier: GPL-3.0-or-later
"""What is written is read back within each format's precision, whatever the splats."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splat_clouds import random_cloud

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.formats import FORMATS, read_splats
from gskin_addon.core.splats.gltf_file import write_gltf
from gskin_addon.core.splats.morton import morton_order
from gskin_addon.core.splats.spz import write_spz


@dataclass(frozen=True)
class Precision:
    """Largest errors: of centres over the farthest coordinate, of log scales, opacities, colours in 0..1, of the angle
    of a rotation (radians), of higher harmonics within -1..1 (None: they are lost)."""

    means: float
    scales: float
    opacities: float
    colors: float
    angle: float
    sh: float | None


BYTE = 0.5 / 255 + 1e-6
PRECISION = {
    "ply": Precision(0.0, 2e-6, 1e-6, 1e-6, 1e-6, 0.0),
    # a 2047th (centres: a 1023rd along y) of what the 256 splats of a chunk span, here up to 2 x the farthest, and 10
    "compressed ply": Precision(1 / 1023, 5 / 1023, BYTE, 10 * 0.2821 / 510, 0.007, 1 / 64 + 1e-6),
    "splat": Precision(0.0, 1e-6, BYTE, BYTE, 0.016, None),
    # SH_C0 / 0.15 steps of a byte for colours; e^-10 to e^5.9 for scales
    "spz": Precision(2**-16, 1 / 32 + 1e-6, BYTE, 1.89 * BYTE, 0.007, 1 / 16 + 1e-6),
    "ksplat": Precision(0.0, 1e-6, BYTE, BYTE, 1e-6, 0.0),
    "gltf": Precision(0.0, 0.0, 0.0, 0.0, 1e-6, 0.0),
    # a 254th of the range that the values span, here up to 10: of log scales and of harmonics
    "sog": Precision(1e-4, 10 / 254, BYTE, 0.2821 * 10 / 254, 0.024, 10 / 254),
}
"""As `docs/formats.md` states it."""


def angles(first, second):
    """Of the rotations between unit quaternions; the chord is exact where the cosine of a small angle is not."""
    a, b = first.astype(np.float64), second.astype(np.float64)
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))


def assert_close(found: SplatCloud, wanted: SplatCloud, limits: Precision) -> None:
    farthest = np.abs(wanted.means).max()
    assert np.abs(found.means - wanted.means).max() <= limits.means * farthest
    np.testing.assert_allclose(np.log(found.scales), np.log(wanted.scales), rtol=0, atol=limits.scales)
    np.testing.assert_allclose(found.opacities, wanted.opacities, rtol=0, atol=limits.opacities)
    np.testing.assert_allclose(found.base_colors(), wanted.base_colors(), rtol=0, atol=limits.colors)
    assert angles(found.quats, wanted.quats).max() <= limits.angle
    if limits.sh is None:
        assert found.sh_degree == 0
    else:
        held = [np.clip(cloud.sh[:, 1:], -1.0, 1.0) for cloud in (found, wanted)]
        np.testing.assert_allclose(*held, rtol=0, atol=limits.sh)


DEGREES = {"ply": 4, "spz": 4, "ksplat": 2}
WRITERS = [(name, form.suffixes[0], form.write, DEGREES.get(name, 3)) for name, form in FORMATS.items()]
WRITERS += [("spz", ".spz", partial(write_spz, version=4), 4), ("gltf", ".gltf", write_gltf, 3)]


@pytest.mark.parametrize(("name", "suffix", "write", "degrees"), WRITERS)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_written_is_read(tmp_path: Path, name, suffix, write, degrees, data):
    count = data.draw(st.sampled_from([1, 2, 255, 256, 257, 1000]))
    cloud = random_cloud(count, data.draw(st.integers(0, degrees)), data.draw(st.integers(0, 2**32 - 1)))
    cloud.means[:] *= data.draw(st.sampled_from([1e-2, 1.0, 100.0]))
    path = tmp_path / f"a{suffix}"
    write(path, cloud)
    loaded = read_splats(path)
    assert loaded.total == count
    np.testing.assert_array_equal(loaded.kept, np.arange(count))
    if name == "compressed ply":
        cloud = cloud.select(morton_order(cloud.means))
    assert_close(loaded.cloud, cloud, PRECISION[name])
