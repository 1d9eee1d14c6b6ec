# SPDX-License-Identifier: GPL-3.0-or-later
"""Bone heat on the asset's own mesh; every splat takes the weights of the place that it was sampled from."""

from __future__ import annotations

import numpy as np

from .base import Method, MethodInput, MethodResult, complete
from .heat import bone_heat, weld


def create(name: str) -> Method:
    """The method."""
    return Method(make)


def make(subject: MethodInput) -> MethodResult:
    """Weights of the welded mesh, at the splats' triangles and barycentric coordinates."""
    surface = subject.surface
    verts, faces, new = weld(surface.verts, surface.faces)
    found, warning = bone_heat(verts, faces, subject.skeleton)
    weights, bare = complete(found, verts, subject.skeleton)
    note = f"{warning or 'no weights'}: {bare} of {len(verts)} vertices follow their nearest bone" if bare else ""
    corners = weights[new[surface.faces[surface.face]]]
    return MethodResult(np.einsum("nk,nkb->nb", surface.bary, corners), note, bare > 0, weights)
