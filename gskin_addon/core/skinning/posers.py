# SPDX-License-Identifier: GPL-3.0-or-later
"""How weights move splats during optimisation: each splat by its own weights, or anchored to a proxy mesh.

A poser takes the weights of its nodes (the splats, or the mesh's vertices). The regularisers act on the nodes
too: the paper's x_j, with the K_1 nearest splats as neighbours or the mesh's own edges (Eq. 10).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ..render.cpu.threads import thread_count
from ..rig.anchoring import Anchors
from ..rig.vertex_maps import mesh_neighbours, rest_rings
from ..splats.cloud import SplatCloud
from .pose_kernels import pose_splats_fused
from .posing import pose_splats, quat_multiply

NEIGHBOURS = 30  # the paper's K_1
_POLAR_STEPS = 6
_SMALLEST = 1e-4


@dataclass(frozen=True)
class Posed:
    """Under P poses: means (P, N, 3) and unit quats (P, N, 4) of the splats, nodes (P, M, 3)."""

    means: torch.Tensor
    quats: torch.Tensor
    nodes: torch.Tensor


class Poser(Protocol):
    """nodes (M, 3) float32: rest positions of the nodes, which have the weights; neighbours (M, K): see
    `mesh_neighbours`."""

    nodes: NDArray[np.float32]
    neighbours: NDArray[np.int64]

    def pose(self, weights: torch.Tensor, transforms: NDArray[Any]) -> Posed:
        """Splats and nodes for weights (M, B) and transforms (P, B, 4, 4), differentiable in the weights."""


class SplatPoser:
    """Vanilla splats: Eq. 1 and Eq. 3 on the splats themselves."""

    def __init__(self, cloud: SplatCloud, neighbours: int = NEIGHBOURS) -> None:
        from scipy.spatial import cKDTree

        self.nodes = cloud.means
        count = min(neighbours + 1, cloud.count)
        tree = cKDTree(cloud.means)
        self.neighbours = tree.query(cloud.means, count, workers=thread_count())[1][:, 1:].astype(np.int64)
        self._quats = cloud.quats

    def pose(self, weights: torch.Tensor, transforms: NDArray[Any]) -> Posed:
        means, quats = pose_splats_fused(self.nodes, self._quats, weights, transforms)
        return Posed(means, quats, means)


class AnchoredPoser:
    """Mesh-anchored splats: Eq. 1 on the vertices, Eq. 4 for the centres, the rotations R_v of Eq. 5.

    The vertices' rotations come from the one-ring maps T_v (see `rig.vertex_maps`) and are blended as quaternions
    with the barycentrics; that is the rotation of the blended matrices to second order in how much the
    triangle's vertices differ. The shear S_v is left out of the renders during optimisation, in which splats keep their
    scales; results are posed with it.
    """

    def __init__(
        self,
        cloud: SplatCloud,
        anchors: Anchors,
        verts: NDArray[Any],
        faces: NDArray[Any],
        neighbours: int = NEIGHBOURS,
        *,
        edges_only: bool = False,
    ) -> None:
        """cloud: N splats; anchors: of the splats on the mesh with verts (V, 3), faces (F, 3); edges_only: see
        `rig.vertex_maps.rest_rings`."""
        self.nodes = np.asarray(verts, np.float32)
        self.neighbours = mesh_neighbours(len(verts), faces, neighbours)
        self._quats = torch.from_numpy(cloud.quats)
        self._verts = torch.from_numpy(self.nodes)
        self._corners = _Rows(faces.ravel(), len(verts))
        self._carriers = _Rows(anchors.face, len(faces))
        self._hooks = _Rows(faces[anchors.face].ravel(), len(verts))
        self._bary = torch.as_tensor(anchors.bary, dtype=torch.float32)
        local = anchors.residual + anchors.beta[:, None] * np.array([0.0, 0.0, 1.0])
        self._local = torch.as_tensor(local, dtype=torch.float32)
        self._reach = torch.ones(len(faces)).index_put(
            (torch.from_numpy(anchors.face),), torch.as_tensor(anchors.reach, dtype=torch.float32)
        )
        rings = rest_rings(np.asarray(verts, np.float64), faces, edges_only=edges_only)
        self._coefficients = torch.as_tensor(rings.coefficients, dtype=torch.float32)
        self._shares = torch.as_tensor(rings.shares, dtype=torch.float32)
        known = np.zeros(len(verts), bool)
        known[faces[rings.shares.any(axis=1)]] = True
        self._unknown = torch.from_numpy(~known)

    def pose(self, weights: torch.Tensor, transforms: NDArray[Any]) -> Posed:
        posed, skinned = pose_splats(self._verts, torch.eye(1, 4).expand(len(self._verts), 4), weights, transforms)
        poses = len(transforms)
        corner = self._corners.take(_rows_first(posed)).view(-1, 3, poses, 3).permute(2, 0, 1, 3)
        frames, radius, double = _frames(corner)
        radius = torch.minimum(radius, self._reach * double.sqrt())
        offset = self._carriers.take(_rows_first(frames * radius[..., None, None])).view(-1, poses, 3, 3)
        hooks = self._hooks.take(_rows_first(posed)).view(-1, 3, poses, 3)
        means = (offset * self._local[:, None, None, :]).sum(-1) + (hooks * self._bary[:, :, None, None]).sum(1)
        means = means.transpose(0, 1).contiguous()
        vertex_quats = self._vertex_quats(corner, frames[..., 2], double, skinned)
        turned = self._hooks.take(_rows_first(vertex_quats)).view(-1, 3, poses, 4).permute(2, 0, 1, 3)
        with torch.no_grad():
            sign = torch.where((turned * turned[:, :, :1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        blend = (turned * sign * self._bary[None, :, :, None]).sum(2)
        quats = torch.nn.functional.normalize(quat_multiply(blend, self._quats), dim=-1)
        return Posed(means, quats, posed)

    def _vertex_quats(
        self, corner: torch.Tensor, normal: torch.Tensor, double: torch.Tensor, skinned: torch.Tensor
    ) -> torch.Tensor:
        """Quaternions (P, V, 4) of R_v; where a ring is inverted, those of the bones (P, V, 4)."""
        poses = len(corner)
        to_next, to_last = corner.roll(-1, 2) - corner, corner.roll(1, 2) - corner
        growth = self._corners.add((double.T[:, None] * self._shares[..., None]).reshape(-1, poses))  # (V, P)
        thick = self._corners.take(growth.clamp_min(1e-12).sqrt()).view(-1, 3, poses).permute(2, 0, 1)
        seen = torch.stack([to_next, to_last, thick[..., None] * normal[:, :, None]], dim=3)
        added = torch.einsum("pfkca,fkcb->fkpab", seen, self._coefficients)
        maps = self._corners.add(added.reshape(-1, 9 * poses)).view(-1, poses, 3, 3).transpose(0, 1)
        bad = (torch.linalg.det(maps.detach()) < _SMALLEST) | self._unknown
        maps = torch.where(bad[..., None, None], torch.eye(3), maps)
        return torch.where(bad[..., None], skinned, matrix_quats(polar_rotation(maps)))


class _Rows:
    """Rows of a matrix by a fixed index, and sums into them; torch's own indexing is ten times slower backward."""

    def __init__(self, index: NDArray[Any], count: int) -> None:
        """index (M,) into `count` rows."""
        from scipy import sparse

        self.index = torch.from_numpy(np.ascontiguousarray(index, np.int64))
        ones = np.ones(len(index), np.float32)
        matrix = sparse.csr_matrix((ones, (index, np.arange(len(index)))), shape=(count, len(index)))
        self.scatter = torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int64)),
            torch.from_numpy(matrix.indices.astype(np.int64)),
            torch.from_numpy(matrix.data),
            size=matrix.shape,
        )

    def take(self, values: torch.Tensor) -> torch.Tensor:
        """values (count, k) -> (M, k)."""
        result: torch.Tensor = _Take.apply(values, self)  # type: ignore[no-untyped-call]
        return result

    def add(self, values: torch.Tensor) -> torch.Tensor:
        """values (M, k) -> sums (count, k)."""
        result: torch.Tensor = _Add.apply(values, self)  # type: ignore[no-untyped-call]
        return result


class _Take(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, rows):  # type: ignore[no-untyped-def]
        ctx.rows = rows
        return values[rows.index]

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return ctx.rows.scatter.to(grad.dtype) @ grad, None


class _Add(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, rows):  # type: ignore[no-untyped-def]
        ctx.rows = rows
        return rows.scatter.to(values.dtype) @ values

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        return grad[ctx.rows.index], None


def _rows_first(values: torch.Tensor) -> torch.Tensor:
    """(P, M, ...) -> (M, P x ...)."""
    return values.transpose(0, 1).reshape(values.shape[1], -1)


def polar_rotation(maps: torch.Tensor) -> torch.Tensor:
    """The rotation of each linear map (..., 3, 3) of positive determinant, differentiable.

    Newton's iteration X <- (X + X^-T) / 2 (Higham 1986), X^-T by cross products; it converges quadratically and starts
    at unit determinant.
    """
    x = maps / torch.linalg.det(maps).clamp_min(_SMALLEST).pow(1 / 3)[..., None, None]
    for _ in range(_POLAR_STEPS):
        a, b, c = x.unbind(-1)
        bc = torch.linalg.cross(b, c)
        cofactor = torch.stack([bc, torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
        x = (x + cofactor / (a * bc).sum(-1)[..., None, None]) / 2
    return x


def matrix_quats(rotation: torch.Tensor) -> torch.Tensor:
    """Unit quaternions (..., 4) wxyz of rotation matrices (..., 3, 3), differentiable; the sign is free."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = (row.unbind(-1) for row in rotation.unbind(-2))
    rows = [
        torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
        torch.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20], -1),
        torch.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12], -1),
        torch.stack([m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22], -1),
    ]
    outer = torch.stack(rows, dim=-2)
    with torch.no_grad():
        best = torch.diagonal(outer, dim1=-2, dim2=-1).argmax(-1)
    picked = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return torch.nn.functional.normalize(picked, dim=-1)


def _frames(corner: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`rig.triangles.face_frames` in torch, from corners (P, F, 3, 3)."""
    first, last = corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]
    across = torch.linalg.cross(first, last)
    # Under the root, so that a triangle without an area has gradients too.
    double = (across.square().sum(-1) + 1e-24).sqrt()
    a, b, c = ((edge.square().sum(-1) + 1e-24).sqrt() for edge in (first, last, last - first))
    normal, tangent = across / double[..., None], first / a[..., None]
    frames = torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=-1)
    return frames, a * b * c / (2 * double), double
