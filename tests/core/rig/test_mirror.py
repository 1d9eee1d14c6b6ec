# SPDX-License-Identifier: GPL-3.0-or-later
"""Left and right of skeletons."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.mirror import (
    mirror_partners,
    mirror_plane,
    mirror_targets,
    mirrored,
    mirrored_name,
    side_of_name,
)
from gskin_addon.core.rig.skeleton import Skeleton


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("Hand.L", "Hand.R"),
        ("hand_l", "hand_r"),
        ("upper_arm.L.001", "upper_arm.R.001"),
        ("mixamorig:LeftForeArm", "mixamorig:RightForeArm"),
        ("J_Bip_L_UpperArm", "J_Bip_R_UpperArm"),
        ("lShldr", "rShldr"),
        ("left_wing", "right_wing"),
        ("Bip01 L Thigh", "Bip01 R Thigh"),
        ("LEFT_LEG", "RIGHT_LEG"),
        ("DEF-thigh.L", "DEF-thigh.R"),
    ],
)
def test_names_of_the_other_side(left, right):
    assert mirrored_name(left) == right
    assert mirrored_name(right) == left
    assert side_of_name(left) == "left"
    assert side_of_name(right) == "right"


@pytest.mark.parametrize("name", ["spine", "Tail", "collar", "Root", "bell", "leftover"])
def test_names_without_a_side(name):
    assert mirrored_name(name) == name
    assert side_of_name(name) == ""


def turned_figure():
    """A figure that looks along no axis, with bones of every kind; and the turn and place it has."""
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    shift = np.array([3.0, -2.0, 0.5])
    names = ("spine", "Arm.L", "Arm.R", "horn a", "horn b", "Pouch", "Leg.L")
    heads = np.array([[0, 0, 0], [0.2, 0, 1], [-0.2, 0, 1], [0.1, 0, 2], [-0.1, 0, 2], [0.3, 0.4, 0], [0.1, 0, 0]])
    tails = np.array([[0, 0, 1], [1, 0, 1], [-1, 0, 1], [0.2, 0, 2.2], [-0.2, 0, 2.2], [0.4, 0.5, 0], [0.1, 0, -1]])
    return Skeleton(names, np.array([-1, 0, 0, 0, 0, 0, 0]), heads @ turn.T + shift, tails @ turn.T + shift), turn


def test_plane_and_partners_of_a_turned_figure():
    skeleton, turn = turned_figure()
    point, normal = mirror_plane(skeleton)
    assert np.allclose(normal, turn[:, 0], atol=1e-9)
    assert np.allclose(mirrored(skeleton.heads[1:2], point, normal), skeleton.heads[2:3])
    assert mirror_partners(skeleton, point, normal).tolist() == [0, 2, 1, 4, 3, -1, -1]


def test_what_one_side_alone_has_goes_with_what_carries_it():
    names = ("spine", "Arm.L", "Arm.R", "Shield.L", "strap", "Pouch", "tail")
    heads = np.array([[0, 0, 0], [0.2, 0, 1], [-0.2, 0, 1], [1, 0, 1], [1.2, 0, 1], [0.3, 0.4, 0], [0, -0.1, 0]])
    tails = np.array([[0, 0, 1], [1, 0, 1], [-1, 0, 1], [1.2, 0, 1], [1.3, 0, 1], [0.4, 0.5, 0], [0.3, -1, 0]])
    skeleton = Skeleton(names, np.array([-1, 0, 0, 1, 3, 0, 0]), heads.astype(float), tails.astype(float))
    point, normal = mirror_plane(skeleton)
    # Shield and strap are carried by the left arm, the pouch by the spine; the tail hangs askew and stays a tail.
    assert mirror_targets(skeleton, point, normal).tolist() == [0, 2, 1, 2, 2, 0, 6]


def test_a_skeleton_without_sides_is_refused():
    skeleton = Skeleton(("a", "b"), np.array([-1, 0]), np.zeros((2, 3)), np.ones((2, 3)))
    with pytest.raises(InputError, match=r"Arm\.L and Arm\.R"):
        mirror_plane(skeleton)
