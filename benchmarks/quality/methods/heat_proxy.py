# SPDX-License-Identifier: GPL-3.0-or-later
"""Bone heat on a proxy made from the splats alone: what a user of Blender must do who has no mesh.

Occupancy of the splats, filled -> marching cubes -> bone heat -> each splat takes the weights of the nearest place
on the proxy. The same steps by hand: points to volume, remesh, Ctrl-P, Transfer Weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gskin_addon.core.rig.nearest import nearest_triangles
from gskin_addon.core.skinning.voxels import voxelize
from gskin_addon.core.splats.cloud import SplatCloud

from .base import Method, MethodInput, MethodResult, complete
from .heat import bone_heat

RESOLUTION = 80
"""Voxels along the longest side: fingers stay apart, and the heat solver needs seconds, not minutes."""


def create(name: str) -> Method:
    """The method."""
    return Method(make)


def proxy_mesh(cloud: SplatCloud, resolution: int = RESOLUTION) -> tuple[NDArray[Any], NDArray[Any]]:
    """A closed surface around the filled splats: verts (V, 3), faces (F, 3)."""
    import igl
    from scipy import ndimage

    grid = voxelize(cloud.means, cloud.opacities, resolution, scales=cloud.scales, quats=cloud.quats)
    density = np.pad(ndimage.gaussian_filter(grid.solid.astype(np.float64), 0.6), 1)
    shape = density.shape
    index = np.stack(np.unravel_index(np.arange(density.size), shape, order="F"), axis=1)  # x runs fastest
    verts, faces, _ = igl.marching_cubes(density.ravel(order="F"), grid.centers(index - 1), *shape, 0.5)
    corner = verts[faces]
    volume = np.einsum("fi,fi->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
    return verts, faces if volume > 0 else faces[:, ::-1]  # the heat looks at normals: outwards


def make(subject: MethodInput) -> MethodResult:
    """Weights of the proxy at the foot points of the splats."""
    verts, faces = proxy_mesh(subject.cloud)
    found, warning = bone_heat(verts, faces, subject.skeleton)
    weights, bare = complete(found, verts, subject.skeleton)
    face, bary = nearest_triangles(subject.cloud.means, verts[faces])
    note = f"{warning or 'no weights'}: {bare} of {len(verts)} vertices follow their nearest bone" if bare else ""
    return MethodResult(np.einsum("nk,nkb->nb", bary, weights[faces[face]]), note, bare > 0)
