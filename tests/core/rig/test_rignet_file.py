# SPDX-License-Identifier: GPL-3.0-or-later
"""RigNet's texts: there and back, and files that are none."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.rig.rignet_file import read_rignet, write_rignet
from gskin_addon.core.rig.skeleton import Skeleton

TEXT = """joints hips 0 1 0
joints head 0 1.8 0.1
joints leg.L 0.1 0.9 0
root hips
hier hips head
hier hips leg.L
skin 0 hips 0.5 leg.L 0.5
skin 2 head 2
skin 1 leg.L 0.25 hips 0.75
"""


def write(tmp_path, text):
    path = tmp_path / "rig.txt"
    path.write_text(text)
    return path


def test_joints_stand_up_and_weights_come_in_the_order_of_vertices(tmp_path):
    rig = read_rignet(write(tmp_path, TEXT))
    assert rig.bones == ("hips", "head", "leg.L")
    assert rig.parents.tolist() == [-1, 0, 0]
    np.testing.assert_allclose(rig.heads, [[0, 0, 1], [0, -0.1, 1.8], [0.1, 0, 0.9]])
    np.testing.assert_allclose(rig.tails[0], [0.05, -0.05, 1.35])
    np.testing.assert_allclose(rig.weights, [[0.5, 0, 0.5], [0.75, 0, 0.25], [0, 1, 0]])


def test_what_is_written_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    heads = rng.random((6, 3))
    parents = np.array([-1, 0, 1, 1, 3, 4])
    names = ("root", "upper arm", "b", "c", "d.001", "e")
    skeleton = Skeleton(names, parents, heads, heads + 0.1)
    weights = rng.random((50, 6)).astype(np.float32) * (rng.random((50, 6)) < 0.5)
    weights[:, 0] += 0.01
    weights /= weights.sum(1, keepdims=True)
    write_rignet(tmp_path / "out.txt", weights, skeleton)
    back = read_rignet(tmp_path / "out.txt")
    assert back.bones == ("root", "upper_arm", "b", "c", "d.001", "e")
    assert back.parents.tolist() == parents.tolist()
    np.testing.assert_allclose(back.heads, heads, atol=1e-6)
    np.testing.assert_allclose(back.weights, weights, atol=1e-5)


def test_children_named_before_their_parents(tmp_path):
    lines = TEXT.splitlines()
    rig = read_rignet(write(tmp_path, "\n".join([lines[1], lines[0], *lines[2:]])))
    assert rig.bones[0] == "hips"
    np.testing.assert_allclose(rig.weights[2], np.array(rig.bones) == "head")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("skin 2 head 2", "skin 2 heat 2", "no joint 'heat'"),
        ("skin 2 head 2", "skin 5 head 2", "not one for each vertex"),
        ("skin 2 head 2", "skin 1 head 2", "not one for each vertex"),
        ("skin 2 head 2", "skin 2 head -1", "line 8: a weight of vertex 2 is negative"),
        ("skin 2 head 2", "skin 2 head nan", "negative or not finite"),
        ("skin 2 head 2", "skin 2 head 0", "has no weights"),
        ("skin 2 head 2", "skin -2 head 1", "no vertex -2"),
        ("skin 2 head 2", "skin 2 head", "is no line of a rig"),
        ("joints head 0 1.8 0.1", "joints hips 0 1.8 0.1", "line 2: the joint 'hips' comes twice"),
        ("joints head 0 1.8 0.1", "joints head 0 inf 0.1", "finite place"),
        ("hier hips head", "hier leg.L hips\nhier hips head", "circle"),
        ("hier hips head", "hier hips head\nhier leg.L head", "two parents"),
        (TEXT, "", "it has no joints"),
        (TEXT, "joints a 0 0 0\nroot a\n", "no skin weights"),
        (TEXT, "v 0 0 0\n", "is no line of a rig"),
    ],
)
def test_damaged_texts_are_refused_in_one_sentence(tmp_path, old, new, said):
    path = write(tmp_path, TEXT.replace(old, new))
    with pytest.raises(InputError, match=said) as caught:
        read_rignet(path)
    assert f"'{path}'" in str(caught.value)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "rig.txt").write_bytes(b"\xff\xfe\x00\x81" * 10)
    with pytest.raises(InputError, match="no text of a rig"):
        read_rignet(tmp_path / "rig.txt")
    with pytest.raises(InputError, match="does not exist"):
        read_rignet(tmp_path / "none.txt")


def test_names_that_would_clash_are_refused(tmp_path):
    heads = np.zeros((2, 3))
    skeleton = Skeleton(("a b", "a_b"), np.array([-1, 0]), heads, heads + 1)
    with pytest.raises(InputError, match="'a_b'"):
        write_rignet(tmp_path / "x.txt", np.ones((1, 2)) / 2, skeleton)
