# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin rig --walls`: files of marked splats as walls."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.commands.selection import read_walls
from gskin_addon.core.errors import InputError


def test_one_file_is_one_side_and_the_rest_the_other(tmp_path):
    (tmp_path / "a.txt").write_text("1 3")
    assert read_walls([tmp_path / "a.txt"], 5).tolist() == [2, 1, 2, 1, 2]


def test_several_files_are_sides_and_the_rest_is_open(tmp_path):
    (tmp_path / "a.txt").write_text("1 3")
    np.savez(tmp_path / "b.npz", selected=np.array([True, False, False, False, False]))
    assert read_walls([tmp_path / "a.txt", tmp_path / "b.npz"], 5).tolist() == [2, 1, 0, 1, 0]


def test_labels_come_as_they_are(tmp_path):
    np.savez(tmp_path / "w.npz", walls=np.array([0, 3, 3, 7]))
    assert read_walls([tmp_path / "w.npz"], 4).tolist() == [0, 3, 3, 7]


def test_what_does_not_fit_is_refused(tmp_path):
    np.savez(tmp_path / "w.npz", walls=np.array([0, 3, 3, 7]))
    with pytest.raises(InputError, match="mark them again"):
        read_walls([tmp_path / "w.npz"], 5)
    (tmp_path / "a.txt").write_text("1 3")
    with pytest.raises(InputError, match="only --walls"):
        read_walls([tmp_path / "w.npz", tmp_path / "a.txt"], 4)
    (tmp_path / "b.txt").write_text("3")
    with pytest.raises(InputError, match=r"b\.txt' and '.*a\.txt' mark the same splats"):
        read_walls([tmp_path / "a.txt", tmp_path / "b.txt"], 4)
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(InputError, match="is no selection"):
        read_walls([tmp_path / "bad.npz"], 4)
    with pytest.raises(InputError, match="does not exist"):
        read_walls([tmp_path / "none.npz"], 4)
