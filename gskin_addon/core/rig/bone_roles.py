# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bone is for, told from its name: head, forearm, wing, IK target.

English names in the ways of writing of Blender, Rigify, Mixamo, Unreal, VRM, MakeHuman and 3ds Max; a name that says
nothing, and any other language, has no role.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

UNKNOWN = "unknown"

_RULES: tuple[tuple[str, str], ...] = (
    # The first rule that finds its words counts: what a bone does not do before what it does, small parts before large.
    ("helper", r"ik|fk|ctrl|control|pole|target|pt|orient|tracker|roll|gp|mch|org|socket|pos|dummy|ground|helper|goal"),
    ("end", r"end|nub|tip"),
    ("hair", r"hair|mane|ponytail|braid|beard|ribbon|bang"),
    ("thumb", r"thumbs?"),
    ("finger", r"fingers?|index|middle|ring|pinky|pinkie|little|digit|metacarpal|phalanx|palm [a-z]"),
    ("toe", r"toes?|ball|footfinger"),
    ("eye", r"eyes?|oculi|eyeball"),
    ("jaw", r"jaw|mouth|chin|tongue|lips?|teeth|beak|oris|proboscis|mandible|pincer"),
    ("face", r"face|brow|eyebrow|lid|eyelid|cheek|nose|snout|special|levator|orbicularis|risorius|temporalis"),
    ("ear", r"ears?|horn|antenna|antler|feeler"),
    ("cloth", r"cape|loincloth|cloak|skirt|cloth|robe|dress|coat|scarf|belt|flag|banner|hat|helmet|hood|backpack|bag"),
    ("thing", r"weapon|sword|gun|axe|shield|staff|bow|club|tool|item|prop|hammer|trigger|magazine|wheel|track|blade"),
    ("wing", r"wing|feather"),
    ("fin", r"fin|flipper|gill|dorsal"),
    ("tail", r"tail|sting|stinger"),
    ("shoulder", r"shoulders?|clavicle|collar|scapula|shoulderbone"),
    ("lower arm", r"forearm|fore arm|lower arm|lowerarm|arm lower|elbow|ellbow|low arm|radius|ulna"),
    ("upper arm", r"upper arm|upperarm|arm upper|up arm|uparm|humerus"),
    ("hand", r"hands?|palm|wrist|fist|claw"),
    ("lower leg", r"lower leg|lowerleg|leg lower|low leg|lowleg|shin|calf|knee|lower thigh"),
    ("upper leg", r"thigh|upper leg|upperleg|leg upper|up leg|upleg|femur|drum"),
    ("foot", r"foot|feet|heel|ankle|paw|hoof|hooves"),
    ("leg", r"legs?|frontleg|backleg|foreleg|hindleg"),
    ("arm", r"arms?|tentacle"),
    ("hips", r"hips?|pelvis|waist|cog|butt"),
    ("neck", r"neck"),
    ("head", r"head|skull"),
    ("chest", r"chest|torso|thorax|ribcage|rib|breast|upper body|body upper|wishbone"),
    ("spine", r"spine|back|backbone|abdomen|belly|stomach|tummy|lumbar|lower back|lower body|body lower"),
    ("body", r"body|trunk|hull"),
    ("root", r"root|master|armature|bone|cube|base"),
)
ROLES = (UNKNOWN, *(role for role, _ in _RULES))
"""All roles; a bone's role is its index here."""

_PATTERNS = tuple(re.compile(rf"\b(?:{words})\b") for _, words in _RULES)
_SEAMS = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])|[^A-Za-z]+")
_EMPTY = frozenset({"l", "r", "left", "right", "skeleton", "mixamorig", "bip", "def", "jnt", "joint", "j", "c"})


def words_of(name: str) -> str:
    """The words of a bone's name in lower case, without numbers, sides and what rigs put before each name."""
    name = name.replace("FBXASC046", ".")  # what FBX makes of a dot
    words = [word.lower() for word in _SEAMS.split(name) if word]
    kept = [word for word in words if word not in _EMPTY]
    if len(kept) > 1 and kept[-1] == "armature":
        kept.pop()
    return " ".join(kept)


def bone_roles(names: Iterable[str]) -> NDArray[np.int8]:
    """(B,) index into `ROLES` for each name."""
    found = []
    for name in names:
        words = words_of(name)
        found.append(next((i for i, p in enumerate(_PATTERNS, start=1) if p.search(words)), 0))
    return np.array(found, np.int8)
