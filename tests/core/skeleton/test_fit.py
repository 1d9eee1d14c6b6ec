# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitted skeletons: joints near those of a person whose joints are known, however it stands and however large it is."""

from __future__ import annotations

from dataclasses import replace

import capsule_person as persons
import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.mirror import mirrored_name
from gskin_addon.core.skeleton import layouts
from gskin_addon.core.skeleton.body_shape import body_shape
from gskin_addon.core.skeleton.fit import fit
from gskin_addon.core.skeleton.landmarks import move_to_landmarks
from gskin_addon.core.skeleton.stance import feet_ahead, quarter_turns, slant, stand
from gskin_addon.core.splats.cloud import SplatCloud


@pytest.fixture(scope="module")
def person():
    return persons.person()


def placed_joints(found):
    placement = found.placement
    return {name: placement[:3, :3] @ place + placement[:3, 3] for name, place in found.joints.items()}


def mean_error(found, joints, diagonal):
    places = placed_joints(found)
    return np.mean([np.linalg.norm(places[name] - place) for name, place in joints.items()]) / diagonal


def test_joints_of_a_person_lie_where_they_are(person):
    found = fit("human", person)
    diagonal = np.linalg.norm(np.ptp(person.means, axis=0))
    assert mean_error(found, persons.joints(), diagonal) < 0.04
    assert not found.unsure
    skeleton = found.placed()
    skeleton.validate()
    assert skeleton.heads[:, 2].min() > -0.01  # feet on the floor
    assert skeleton.tails[skeleton.names.index("spine.006"), 2] == pytest.approx(person.means[:, 2].max(), abs=0.06)


@pytest.mark.parametrize("degrees", [90, -130])
def test_it_follows_a_body_that_is_turned_moved_and_scaled(person, degrees):
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    quat = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)], np.float32)
    moved = replace(
        person,
        means=(100 * person.means @ turn.T + [50, -20, 7]).astype(np.float32),
        quats=np.tile(quat, (len(person.means), 1)),
        scales=person.scales * 100,
    )
    found = fit("human", moved)
    expected = {name: 100 * turn @ place + [50, -20, 7] for name, place in persons.joints().items()}
    assert mean_error(found, expected, 100 * np.linalg.norm(np.ptp(person.means, axis=0))) < 0.045


def test_sides_are_mirror_images_or_not_as_wished(person):
    for wanted in (True, False):
        found = fit("human", person, front="-y", alike=wanted)
        assert found.alike is wanted
        names, heads = found.skeleton.names, found.skeleton.heads
        twin = [names.index(mirrored_name(name)) for name in names]
        off = np.abs(heads[twin] * [-1, 1, 1] - heads).max()
        assert (off < 1e-12) == wanted


def test_landmarks_bring_the_ends_of_limbs_there(person):
    goal = np.array([0.75, -0.1, 1.3])
    marks = {"hand.L": goal, "knee.R": np.array([-0.2, 0, 0.5])}
    found = fit("human", person, front="-y", alike=False, landmarks=marks)
    plain = fit("human", person, front="-y", alike=False)
    joints, before = placed_joints(found), placed_joints(plain)
    np.testing.assert_allclose(joints["knee.R"], [-0.2, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(joints["shoulder.L"], before["shoulder.L"], atol=1e-9)
    way, to_goal = joints["wrist.L"] - joints["shoulder.L"], goal - joints["shoulder.L"]
    assert way @ to_goal / np.linalg.norm(way) / np.linalg.norm(to_goal) > 0.97
    placed = found.placed()
    hand = placed.names.index("hand.L")
    palm = placed.tails[hand] - placed.heads[hand]  # as the layout has it, six tenths of the way to the fingertips
    np.testing.assert_allclose(placed.heads[hand] + palm / 0.6, goal, atol=1e-6)
    with pytest.raises(InputError, match=r"'hand.X' is no landmark of this body; choose one of head, hand.L"):
        move_to_landmarks(plain.joints, {"hand.X": goal}, person.means)


def test_a_landmark_of_one_side_holds_for_the_other_where_both_are_alike(person):
    goal = np.array([0.62, -0.1, 1.1])
    found = fit("human", person, front="-y", landmarks={"hand.L": goal})
    assert found.alike
    joints = placed_joints(found)
    np.testing.assert_allclose(joints["wrist.R"] * [-1, 1, 1], joints["wrist.L"], atol=0.05)  # its plane is near x = 0
    plain = placed_joints(fit("human", person, front="-y"))
    assert joints["wrist.L"][2] > plain["wrist.L"][2] + 0.05
    np.testing.assert_allclose(joints["knee.R"], plain["knee.R"], atol=1e-6)


def test_landmarks_that_contradict_one_another_leave_the_sides_apart(person):
    goals = {"hand.L": np.array([0.62, -0.1, 1.1]), "hand.R": np.array([-0.3, -0.4, 1.5])}
    assert not fit("human", person, front="-y", landmarks=goals).alike


def test_what_cannot_be_fitted_says_so(person):
    with pytest.raises(InputError, match="'fish' is no kind of skeleton; choose one of human"):
        fit("fish", person)
    with pytest.raises(InputError, match="'up' is no direction to look to"):
        fit("human", person, front="up")
    with pytest.raises(InputError, match="at least two splats"):
        fit("human", person.select(np.arange(len(person.means)) < 1))


@pytest.mark.parametrize("bones", [layouts.HUMAN, layouts.QUADRUPED, layouts.BIRD])
def test_tables_of_bones_list_parents_first_and_have_both_sides(bones):
    names = [bone.name for bone in bones]
    assert len(set(names)) == len(names)
    for number, bone in enumerate(bones):
        assert not bone.parent or bone.parent in names[:number]
        assert "*" not in bone.parent or "*" in bone.name


def test_a_slanted_body_is_set_straight_and_a_straight_one_left(person):
    assert slant(person.means.astype(float)) == 0.0
    angle = np.radians(24)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    assert slant(person.means @ turn.T) == pytest.approx(-angle, abs=np.radians(3.1))


def test_the_landmark_of_the_head_is_its_top_not_its_joint(person):
    plain = fit("human", person, front="-y", alike=False)
    top = np.array([0.0, 0.0, 2.0])
    found = fit("human", person, front="-y", alike=False, landmarks={"head": top})
    before, after = placed_joints(plain)["head"], placed_joints(found)["head"]
    assert before[2] < after[2] < 1.85  # the neck is longer; the joint stays below the crown


def bird():
    """A trunk, a neck with a head, a tail and two legs; it looks along -y."""
    rng = np.random.default_rng(2)
    parts = (
        ((0, 0.1, 0.5), (0.13, 0.28, 0.14)), ((0, -0.28, 0.78), (0.05, 0.05, 0.14)),
        ((0, -0.34, 0.92), (0.06, 0.09, 0.06)), ((0, 0.5, 0.55), (0.06, 0.2, 0.03)),
        *(((x, 0.1, 0.2), (0.02, 0.02, 0.2)) for x in (0.08, -0.08)),
        *(((x, 0.05, 0.02), (0.03, 0.08, 0.02)) for x in (0.08, -0.08)),
    )  # fmt: skip
    points = []
    for middle, radii in parts:
        ball = rng.normal(size=(1500, 3))
        points.append(np.array(middle) + ball / np.linalg.norm(ball, axis=1, keepdims=True) * radii)
    means = np.concatenate(points).astype(np.float32)
    return SplatCloud(
        means, np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)), np.full_like(means, 0.008),
        np.full(len(means), 0.9, np.float32), np.zeros((len(means), 1, 3), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("front", ["auto", "-y"])
def test_a_birds_ends_lie_at_its_ends_and_it_always_wants_looking_at(front):
    found = fit("bird", bird(), front=front)
    assert found.unsure
    skeleton = found.placed()
    skeleton.validate()
    place = {name: number for number, name in enumerate(skeleton.names)}
    beak, tail = skeleton.tails[place["head"]], skeleton.tails[place["spine"]]
    assert np.linalg.norm(beak - [0, -0.42, 0.92]) < 0.12
    assert np.linalg.norm(tail - [0, 0.69, 0.55]) < 0.12
    for side, sign in (("L", 1), ("R", -1)):
        assert np.linalg.norm(skeleton.heads[place[f"toe.{side}"]] - [sign * 0.08, 0.06, 0.0]) < 0.08
        assert 0.3 < skeleton.heads[place[f"thigh.{side}"], 2] < 0.62


def test_feet_reach_to_the_front(person):
    ahead = [feet_ahead(stand(turn, "height")) for turn in quarter_turns(body_shape(person))]
    assert ahead[0] > 0.03
    assert ahead[2] == pytest.approx(-ahead[0], abs=0.01)


@pytest.mark.parametrize("kind", ["human", "bird"])
def test_a_landmark_of_a_side_says_to_where_the_body_looks(person, kind):
    marks = persons.joints()
    for side, other in (("L", "L"), ("L", "R"), ("R", "L")):  # where it is, and with the sides taken for one another
        name = {"human": f"hand.{side}", "bird": f"wing.{side}"}[kind]
        found = fit(kind, person, landmarks={name: marks[f"wrist.{other}"]})
        left = found.placement[0, 0]
        assert left * (1 if side == other else -1) > 0.9, (side, other)
        assert found.front_sure
