# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons of other programs: read from their files, and brought into splats."""

from __future__ import annotations

import capsule_person as persons
import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.nearest_points import nearest_points
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skeleton.placing import _Body, guess_placing
from gskin_addon.core.skeleton.read import read_skeleton_file

RIGNET = """joints hip 0 1 0
joints knee 0 0.5 0.1
joints ankle 0 0 0
joints spine 0 1.5 0
root hip
hier hip knee
hier knee ankle
hier hip spine
skin 0 hip 0.5 knee 0.5
info Scale 1.0
"""

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 25 0
    }
  }
  JOINT LeftUpLeg
  {
    OFFSET 9 -5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -40 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 -40 0
      }
    }
  }
}
MOTION
Frames: 1
"""


def test_a_text_of_joints(tmp_path):
    path = tmp_path / "rig.txt"
    path.write_text(RIGNET)
    skeleton = read_skeleton_file(path)
    skeleton.validate()
    parents = {name: skeleton.parents[i] for i, name in enumerate(skeleton.names)}
    assert skeleton.names[parents["knee"]] == "hip"
    assert skeleton.names[parents["ankle"]] == "knee"
    assert parents["hip"] == -1
    knee, ankle = skeleton.names.index("knee"), skeleton.names.index("ankle")
    np.testing.assert_allclose(skeleton.tails[knee], [0, 0, 0])
    np.testing.assert_allclose(skeleton.tails[ankle], [0, -0.25, -0.05])  # half its parent's length further


def test_arrays_with_objects_in_them_as_unirig_writes_them(tmp_path):
    path = tmp_path / "predict_skeleton.npz"
    joints = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2], [1, 0, 1.0]])
    names = np.array(["a", "b", "c", "b"], dtype=object)
    parents = np.array([None, 0, 1, 1], dtype=object)
    np.savez(path, joints=joints, parents=parents, names=names, tails=joints + [0, 0, 0.5])
    skeleton = read_skeleton_file(path)
    assert skeleton.names == ("a", "b", "c", "b.001")
    assert skeleton.parents.tolist() == [-1, 0, 1, 1]
    np.testing.assert_allclose(skeleton.tails, joints + [0, 0, 0.5])


def test_arrays_as_skintokens_writes_them(tmp_path):
    path = tmp_path / "rig.npz"
    joints = np.array([[0, 0, 2], [0, 0, 1], [0, 0, 0.0]])
    names = np.array(["tip", "middle", "root"], dtype=object)
    np.savez(path, joints=joints, parents=np.array([1, 2, -1], np.int32), joint_names=names, skin=np.zeros((5, 3)))
    skeleton = read_skeleton_file(path)
    assert skeleton.names == ("root", "middle", "tip")  # parents first
    assert skeleton.parents.tolist() == [-1, 0, 1]


def test_a_pickle_in_the_arrays_is_not_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "mark"), "w"))

    path = tmp_path / "bad.npz"
    parents = np.array([None, Bomb()], dtype=object)
    np.savez(path, joints=np.zeros((2, 3)), parents=parents)
    with pytest.raises(InputError, match=r"bad.npz' cannot be read \(a list of something else"):
        read_skeleton_file(path)
    assert not (tmp_path / "mark").exists()


def test_a_motion_file(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(BVH)
    skeleton = read_skeleton_file(path)
    skeleton.validate()
    leg = skeleton.names.index("LeftLeg")
    np.testing.assert_allclose(skeleton.heads[leg], [9, 45, 0])
    np.testing.assert_allclose(skeleton.tails[leg], [9, 5, 0])
    np.testing.assert_allclose(skeleton.tails[skeleton.names.index("Spine")], [0, 125, 0])


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.txt", "joints a 0 0\n", "Line 1 of .* is damaged"),
        ("a.txt", "hello\n", "has no 'joints' lines"),
        ("a.txt", "joints a 0 0 0\nhier a b\n", "joins 'b', which has no 'joints' line"),
        ("a.txt", "joints a 0 0 0\njoints b 0 0 1\nhier a b\nhier b a\n", "is no tree"),
        ("a.txt", "joints a nan 0 0\n", "NaN or infinity"),
        ("a.bvh", "MOTION\n", "does not begin with HIERARCHY"),
        ("a.bvh", "HIERARCHY ROOT a { OFFSET 0 0", "ends too soon"),
        ("a.bvh", "HIERARCHY ROOT a { JUMP", "'JUMP' is unknown"),
        ("a.npz", "no zip", "cannot be read"),
        ("a.obj", "v 0 0 0", "is no skeleton file; give a .txt, .npz, .bvh file"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path, name, text, reason):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        read_skeleton_file(path)


def person_skeleton() -> Skeleton:
    chains = {
        "hips": "", "neck": "hips", "head": "neck", "shoulder.*": "neck", "elbow.*": "shoulder.*", "wrist.*": "elbow.*",
        "thigh.*": "hips", "knee.*": "thigh.*", "ankle.*": "knee.*", "toe.*": "ankle.*",
    }  # fmt: skip
    joints = persons.joints()
    names, parents = [], []
    for name, parent in chains.items():
        for side in "LR" if "*" in name else " ":
            names.append(name.replace("*", side))
            parents.append(names.index(parent.replace("*", side)) if parent else -1)
    heads = np.array([joints[name] for name in names])
    return Skeleton(tuple(names), np.array(parents), heads, heads + [0, 0, 0.05])


Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
X_UP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])


@pytest.mark.parametrize(
    ("turn", "scale", "shift"),
    [
        (np.eye(3), 1.0, (0, 0, 0)),
        (Y_UP, 1.0, (0, 0, 0)),
        (Y_UP, 100.0, (0, 0, 0)),
        (Y_UP, 1.1, (0, -0.9, 0)),  # as networks see bodies: in the middle of a cube
        (X_UP, 0.37, (5, 2, 1)),
    ],
)
def test_axes_unit_and_place_are_guessed(turn, scale, shift):
    points, right = persons.person(3000).means, person_skeleton()
    placing = guess_placing(right.moved(turn, scale, shift), points)
    found = placing.of(right.moved(turn, scale, shift))
    off = np.linalg.norm(found.heads - right.heads, axis=1).mean() / np.linalg.norm(np.ptp(points, axis=0))
    assert off < 0.03, placing
    assert not placing.unsure
    assert (placing.plain == "") == np.array_equal(turn, np.eye(3))


@pytest.mark.parametrize("offset", [0, 1e5])
def test_the_misfit_is_how_far_bones_and_body_are_from_one_another(offset):
    rng = np.random.default_rng(4)
    body = _Body.of(rng.normal(size=(2000, 3)) + offset)
    bones = rng.normal(size=(300, 3)) + offset
    there, back = nearest_points(bones, body.points, 1)[0], nearest_points(body.points, bones, 1)[0]
    expected = (np.sqrt(np.square(there).mean()) + np.sqrt(np.square(back).mean())) / 2 / body.diagonal
    np.testing.assert_allclose(body.misfit(bones), expected, rtol=1e-9)


def test_what_is_alike_from_front_and_back_is_said():
    """A bar on a post, turned by a right angle and scaled: nothing tells its front from its back."""
    rng = np.random.default_rng(3)
    post = rng.uniform((-0.1, -0.1, 0), (0.1, 0.1, 1.6), (800, 3))
    bar = rng.uniform((-0.8, -0.1, 1.4), (0.8, 0.1, 1.6), (800, 3))
    heads = np.array([[0, 0, 0.1], [0, 0, 1.5], [0.7, 0, 1.5], [-0.7, 0, 1.5]], float)
    skeleton = Skeleton(("a", "b", "c", "d"), np.array([-1, 0, 1, 1]), heads, heads + (0, 0, 0.1))
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    points = np.concatenate([post, bar]) @ turn.T * 2.5
    placing = guess_placing(skeleton, points)
    assert placing.either_way
    # A nose tells it.
    nose = rng.uniform((-0.1, -1.2, 0.4), (0.1, 0, 0.6), (800, 3))
    longer = np.concatenate([heads, [[0, 0, 0.5], [0, -1.1, 0.5]]])
    skeleton = Skeleton((*"abcdef",), np.array([-1, 0, 1, 1, 0, 4]), longer, longer + (0, 0, 0.1))
    points = np.concatenate([post, bar, nose]) @ turn.T * 2.5
    placing = guess_placing(skeleton, points)
    assert not placing.either_way
    np.testing.assert_allclose(placing.of(skeleton).heads, longer @ turn.T * 2.5, atol=0.3)
