# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons in .npz files: UniRig's (joints, parents, names, tails) and SkinTokens' (joints, parents, joint_names)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..rig.skeleton import Skeleton
from .joint_tree import skeleton_of_joints
from .plain_objects import read_plain


def read_joint_arrays(path: Path) -> Skeleton:
    """The skeleton in an .npz with joints (J, 3) and parents (J,), None or negative for a root, with the file's axes.

    Raises:
        InputError: not readable, or without these arrays.
    """
    found = read_plain(path, ("joints", "parents", "names", "joint_names", "tails"))
    for name in ("joints", "parents"):
        if name not in found:
            raise InputError(f"'{path}' has no array '{name}'; give a skeleton as UniRig or SkinTokens write it.")
    try:
        joints = np.asarray(found["joints"], np.float64).reshape(-1, 3)
        parents = [-1 if parent is None or float(parent) < 0 else int(parent) for parent in list(found["parents"])]
        texts = found.get("names", found.get("joint_names"))
        names = [f"bone_{number}" for number in range(len(joints))] if texts is None else [str(t) for t in list(texts)]
        tails = None if "tails" not in found else np.asarray(found["tails"], np.float64).reshape(-1, 3)
    except (ValueError, TypeError) as error:
        raise InputError(f"'{path}' is no skeleton ({error}); write the file again.") from None
    if not len(joints) == len(parents) == len(names) or (tails is not None and len(tails) != len(joints)):
        raise InputError(f"'{path}' has arrays of different lengths; write the file again.")
    return skeleton_of_joints(names, parents, joints, tails, label=f"'{path}'")
