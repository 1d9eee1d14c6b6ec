# SPDX-License-Identifier: GPL-3.0-or-later
"""Joints of artists' rigs, told from the names of their bones."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skeleton.joints import HUMAN, both_sides, facing, human_bones, joints_of, quadruped_bones

MIXAMO = """Hips; Spine<Hips; Spine1<Spine; Neck<Spine1; Head<Neck; HeadTop_End<Head
LeftShoulder<Spine1; LeftArm<LeftShoulder; LeftForeArm<LeftArm; LeftHand<LeftForeArm; LeftHandIndex1<LeftHand
RightShoulder<Spine1; RightArm<RightShoulder; RightForeArm<RightArm; RightHand<RightForeArm
LeftUpLeg<Hips; LeftLeg<LeftUpLeg; LeftFoot<LeftLeg; LeftToeBase<LeftFoot
RightUpLeg<Hips; RightLeg<RightUpLeg; RightFoot<RightLeg; RightToeBase<RightFoot"""

RIGIFY = """hips; spine<hips; chest<spine; neck<chest; head<neck
shoulder.L<chest; upper_arm.L<shoulder.L; forearm.L<upper_arm.L; hand.L<forearm.L; f_index.01.L<hand.L
shoulder.R<chest; upper_arm.R<shoulder.R; forearm.R<upper_arm.R; hand.R<forearm.R
thigh.L<hips; shin.L<thigh.L; foot.L<shin.L; toe.L<foot.L
thigh.R<hips; shin.R<thigh.R; foot.R<shin.R; toe.R<foot.R"""

TARGETS = """Bone; Body<Bone; Hips<Body; Neck<Hips; Head<Neck
UpperArm.L<Hips; LowerArm.L<UpperArm.L; Palm.L<LowerArm.L; UpperArm.R<Hips; LowerArm.R<UpperArm.R; Palm.R<LowerArm.R
UpperLeg.L<Body; LowerLeg.L<UpperLeg.L; UpperLeg.R<Body; LowerLeg.R<UpperLeg.R
Foot.L<Bone; PoleTarget.L<Bone; Foot.R<Bone; PoleTarget.R<Bone"""
"""Feet hang on the root, where they follow targets."""

HEIGHT = {
    "hips": 1.0, "body": 0.95, "spine": 1.1, "chest": 1.3, "neck": 1.5, "head": 1.6, "arm": 1.4, "leg": 0.9,
    "thigh": 0.9,
}  # fmt: skip


def rig(text):
    names, parents = [], []
    for word in text.replace("\n", ";").split(";"):
        name, _, parent = word.strip().partition("<")
        names.append(name)
        parents.append(names.index(parent) if parent else -1)
    heads = np.zeros((len(names), 3))
    for number, name in enumerate(names):
        low = name.lower()
        heads[number, 2] = next((h for word, h in HEIGHT.items() if word in low), 0.1)
        side = 1 if "left" in low or low.endswith(".l") else -1 if "right" in low or low.endswith(".r") else 0
        heads[number, 0] = 0.2 * side
    heads[:, 1] = np.arange(len(names)) * 1e-3
    return Skeleton(tuple(names), np.array(parents), heads, heads + [0, 0, 0.05])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (MIXAMO, {"hips": "Hips", "shoulder.L": "LeftArm", "elbow.L": "LeftForeArm", "knee.R": "RightLeg",
                  "thigh.R": "RightUpLeg", "toe.L": "LeftToeBase", "wrist.R": "RightHand", "head": "Head"}),
        (RIGIFY, {"hips": "hips", "shoulder.R": "upper_arm.R", "knee.L": "shin.L", "ankle.L": "foot.L"}),
        (TARGETS, {"ankle.L": "Foot.L", "wrist.L": "Palm.L", "knee.R": "LowerLeg.R", "thigh.R": "UpperLeg.R"}),
    ],
)  # fmt: skip
def test_joints_of_a_person_by_the_names_of_the_bones(text, expected):
    skeleton = rig(text)
    found = {joint: skeleton.names[bone] for joint, bone in human_bones(skeleton).items()}
    assert {joint: found.get(joint) for joint in expected} == expected
    if text != TARGETS:
        assert set(found) == set(both_sides(HUMAN))


def test_bones_without_weights_come_after_others_of_the_same_name():
    skeleton = rig("root; head<root; body<root; neck<body; Head.001<neck")
    used = np.array([True, False, True, True, True])
    assert skeleton.names[human_bones(skeleton, used)["head"]] == "Head.001"


def test_a_quadrupeds_joints_and_where_it_looks():
    text = "Body; Back<Body; Torso<Back; Neck1<Torso; Head<Neck1; Tail1<Back"
    for side in "LR":
        text += f"; FrontUpperLeg.{side}<Torso; FrontLowerLeg.{side}<FrontUpperLeg.{side}; IKFrontLeg.{side}"
        text += f"; BackLeg.{side}<Back; BackUpperLeg.{side}<BackLeg.{side}; BackLowerLeg.{side}<BackUpperLeg.{side}"
        text += f"; IKBackLeg.{side}"
    skeleton = rig(text)
    found = {joint: skeleton.names[bone] for joint, bone in quadruped_bones(skeleton).items()}
    assert found["foot.L"] == "BackLowerLeg.L"
    assert found["front_toe.R"] == "IKFrontLeg.R"
    assert quadruped_bones(rig(MIXAMO)) == {}
    np.testing.assert_allclose(facing(joints_of(skeleton, quadruped_bones(skeleton)))[:2], [0, -1], atol=0.02)
    assert facing({"hips": np.zeros(3)}) is None
