# SPDX-License-Identifier: GPL-3.0-or-later
"""How sure the weights of splats are, in one number for panels."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..scene import names
from ..scene.attributes import read_attribute

SURE = 0.5
"""Confidence from which on a splat counts as sure; Select Unsure Splats begins with the same."""

_shares: dict[tuple[int, int], float] = {}


def sure_share(splats: bpy.types.Object) -> float | None:
    """Share (0 to 1) of the splats whose weights are sure; None where they do not know, or are being edited.

    Remembered for the mesh: new weights come with a new one.
    """
    mesh: Any = splats.data
    if names.CONFIDENCE not in mesh.attributes or splats.mode == "EDIT":
        return None
    key = (mesh.session_uid, len(mesh.vertices))
    if key not in _shares:
        values = read_attribute(mesh, names.CONFIDENCE)
        if values is None or not len(values):
            return None
        if len(_shares) >= 8:
            _shares.clear()
        _shares[key] = float(np.mean(values >= SURE))
    return _shares[key]
