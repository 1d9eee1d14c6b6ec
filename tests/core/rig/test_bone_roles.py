# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bone is for, from names as the usual tools write them."""

from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.rig.bone_roles import ROLES, bone_roles, words_of

NAMES = {
    "head": ("Head", "mixamorig:Head", "Bip01 Head", "J_Bip_C_Head", "DEF-head", "skull"),
    "upper arm": ("LeftUpperArm", "upperarm_l", "DEF-upper_arm.L.001", "skeleton_arm_upper.R", "upperarm02.R"),
    "lower arm": ("mixamorig:LeftForeArm", "lowerarm_l", "Bip01 L Forearm", "LowerArm.R", "Left elbow"),
    "arm": ("LeftArm", "Arm_R"),
    "hand": ("hand_r", "LeftHand", "DEF-hand.L", "Fist.L", "Wrist_R", "J_Bip_L_Hand"),
    "finger": ("LeftHandIndex1", "pinky_02_r", "DEF-f_middle.03.L", "Fingers.L", "MiddleFinger4.L", "metacarpal3.L"),
    "thumb": ("LeftHandThumb1", "thumb_01_l", "Thumb2.R"),
    "upper leg": ("LeftUpLeg", "thigh_l", "DEF-thigh.L", "BackUpperLeg.R", "upperleg01.L"),
    "lower leg": ("calf_r", "DEF-shin.R.001", "LowerLeg.L", "Left knee", "FrontLowLeg.R"),
    "foot": ("Foot.L", "mixamorig:RightFoot", "foot_l", "Left ankle"),
    "toe": ("LeftToeBase", "ball_l", "DEF-toe.L", "toe5-1.L"),
    "hips": ("Hips", "pelvis", "J_Bip_C_Hips"),
    "spine": ("spine_02", "Spine1", "Abdomen", "DEF-spine.003"),
    "chest": ("Chest", "UpperChest", "Torso"),
    "shoulder": ("clavicle_r", "LeftShoulder", "DEF-shoulder.L"),
    "neck": ("neck_01", "Neck3"),
    "tail": ("Tail4", "tail.001"),
    "wing": ("Wing2.L", "wing_upper.R"),
    "helper": ("PoleTarget.L", "IKFrontLeg.R", "LeftFootCtrl", "foot_ik.L", "hand_l_ik", "FootRollCtrl"),
    "end": ("Head_end", "HeadTop_End_end", "Bip01 HeadNub", "LeftToe_End", "ToeNub"),
    "root": ("Root", "Armature_rootJoint", "Bone.003", "MASTER"),
    "unknown": ("Kopf", "12", "", "f3b.l", "Oberarm"),
}


@pytest.mark.parametrize("role", NAMES)
def test_names_of_usual_rigs(role):
    assert [(name, ROLES[i]) for name, i in zip(NAMES[role], bone_roles(NAMES[role]), strict=True)] == [
        (name, role) for name in NAMES[role]
    ]


def test_sides_numbers_and_case_say_nothing():
    assert words_of("LeftUpLeg.001") == words_of("right_up-leg") == "up leg"
    assert words_of("upper_armFBXASC046L_Armature") == "upper arm"
    assert words_of("Armature") == "armature"
    names = ("Hand.L", "hand_r", "RightHand3", "HAND", "skeleton_hand")
    assert len(set(bone_roles(names).tolist())) == 1


def test_shape_and_range():
    assert bone_roles(()).shape == (0,)
    roles = bone_roles(f"bone {i}" for i in range(7))
    assert roles.shape == (7,)
    assert roles.dtype == np.int8
    assert len(set(ROLES)) == len(ROLES) < 127
