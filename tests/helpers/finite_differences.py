# SPDX-License-Identifier: GPL-3.0-or-later
"""What an object's modifiers really do around each of its points, and how splats compare with it."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np

from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.scene.attributes import read_attribute, read_positions, write_positions
from gskin_addon.scene.node_groups import find_display, set_display


@dataclasses.dataclass
class Truth:
    """Moved points (N, 3) and Jacobians (N, 3, 3), object space."""

    points: np.ndarray
    maps: np.ndarray

    def covariances(self, quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
        """(N, 3, 3) of the mapped Gaussians."""
        return self.maps @ covariances(quats, scales) @ self.maps.swapaxes(1, 2)

    def turn_error(self, turn: np.ndarray) -> np.ndarray:
        """(N,) degrees between turns (N, 4) and the rotations of the maps; a mirroring map counts as its negative."""
        sign = np.where(np.linalg.det(self.maps) < 0, -1.0, 1.0)[:, None, None]
        u, _, vt = np.linalg.svd(self.maps * sign)
        between = quat_to_matrix(turn.astype(float)).swapaxes(1, 2) @ (u @ vt)
        # From the antisymmetric part too: the arc cosine alone loses small angles.
        axial = np.stack([between[:, i, j] - between[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
        return np.degrees(np.arctan2(np.linalg.norm(axial, axis=1), np.trace(between, axis1=1, axis2=2) - 1))


@dataclasses.dataclass
class Shown:
    """The evaluated splats: points, rotation, scale, turn."""

    points: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    turn: np.ndarray


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    axes = quat_to_matrix(np.asarray(quats, float)) * np.asarray(scales, float)[:, None, :]
    return axes @ axes.swapaxes(1, 2)


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) distances of covariances, relative to the second."""
    return np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(b, axis=(1, 2))


def shown(obj: bpy.types.Object) -> Shown:
    """What the viewport's modifiers make of the splats, display off."""
    if find_display(obj) is not None:
        set_display(obj, "Display", False)
    bpy.context.view_layer.update()
    mesh = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    found = [read_attribute(mesh, name).astype(float) for name in ("rotation", "scale", "gskin:turn")]
    return Shown(read_positions(mesh).astype(float), *found)


def truth(obj: bpy.types.Object, step: float = 2e-4) -> Truth:
    """By central differences of everything but node groups."""
    copy = obj.copy()
    copy.data = mesh = obj.data.copy()
    for key in [key for key in list(mesh.keys()) if key.startswith("gskin")]:
        del mesh[key]
    for modifier in [modifier for modifier in copy.modifiers if modifier.type == "NODES"]:
        copy.modifiers.remove(modifier)
    bpy.context.scene.collection.objects.link(copy)

    def moved(points: np.ndarray) -> np.ndarray:
        write_positions(mesh, points)
        copy.update_tag()
        bpy.context.view_layer.update()
        return read_positions(copy.evaluated_get(bpy.context.evaluated_depsgraph_get()).data).astype(float)

    rest = read_positions(obj.data)
    maps = np.empty((len(rest), 3, 3))
    for axis in range(3):
        ends = []
        for sign in (1, -1):
            displaced = rest.copy()
            displaced[:, axis] += np.float32(sign * step)
            ends.append((displaced, moved(displaced)))
        (a, at_a), (b, at_b) = ends
        maps[:, :, axis] = (at_a - at_b) / (a[:, axis].astype(float) - b[:, axis])[:, None]
    points = moved(rest)
    bpy.data.objects.remove(copy)
    bpy.data.meshes.remove(mesh)
    return Truth(points, maps)
