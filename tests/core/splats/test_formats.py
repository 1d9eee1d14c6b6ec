# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
from splat_clouds import random_cloud

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.formats import read_splats, write_splats


def test_a_file_is_known_by_what_it_holds(tmp_path):
    cloud = random_cloud(20, 1)
    write_splats(tmp_path / "a.PLY", cloud)
    (tmp_path / "renamed.bin").write_bytes((tmp_path / "a.PLY").read_bytes())
    for name in ("a.PLY", "renamed.bin"):
        np.testing.assert_array_equal(read_splats(tmp_path / name).cloud.means, cloud.means)


def test_what_is_no_splat_file_is_named_with_a_remedy(tmp_path):
    (tmp_path / "b.spz").write_bytes(b"\x1f\x8b something else")
    (tmp_path / "b.lcc").write_bytes(b"something else")
    (tmp_path / "c.ply").write_bytes(b"no header")
    with pytest.raises(InputError, match=r"b\.spz' is damaged \(it cannot be unpacked.*export it again"):
        read_splats(tmp_path / "b.spz")
    with pytest.raises(InputError, match=r"b\.lcc' is a capture of XGRIDS; turn it into a \.ply .* splat-transform"):
        read_splats(tmp_path / "b.lcc")
    with pytest.raises(InputError, match=r"c\.ply"):
        read_splats(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"d\.ply' does not exist"):
        read_splats(tmp_path / "d.ply")
    with pytest.raises(InputError, match=r"out\.txt' is no \.ply, .* file; choose another name"):
        write_splats(tmp_path / "out.txt", random_cloud(3, 0))
    assert not (tmp_path / "out.txt").exists()


def test_a_coordinate_is_not_taken_for_gzip(tmp_path):
    """A .splat begins with the first splat's x, which may be any bytes."""
    cloud = random_cloud(4, 0)
    cloud.means[0, 0] = np.frombuffer(b"\x1f\x8b\x10\x40", "<f4")[0]
    write_splats(tmp_path / "a.splat", cloud)
    assert (tmp_path / "a.splat").read_bytes()[:2] == b"\x1f\x8b"
    np.testing.assert_array_equal(read_splats(tmp_path / "a.splat").cloud.means, cloud.means)
