# SPDX-License-Identifier: GPL-3.0-or-later
"""Examples for the networks that find joints: rigged meshes in other poses and proportions, as voxels and joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rig.kinematics import joints_posed
from ...rig.mirror import mirrored_name
from ...rig.poses import random_axes
from ...rig.quaternion import axis_angle_to_matrix
from ...rig.skeleton import Skeleton, parents_first
from ...skeleton.body_shape import body_shape
from ...skeleton.joints import both_sides, facing, joints_of
from ...skeleton.stance import stand
from ...skeleton.votes import features
from ...splats.from_mesh import sample_mesh
from ..prior.proportions import proportion_transforms
from ..rigged import RiggedMesh, with_bones

Array = NDArray[Any]

STRETCH, GIRTH = 0.18, 0.15
"""Standard deviations of the logarithm of a bone's length and of the width around it."""

SPLATS = 6000
VOXELS = 512


@dataclass(frozen=True)
class Example:
    """values (VOXELS, F): features of some voxels; joints (J, 3) in the same unit, NaN where unknown, as
    `both_sides`; diagonal: of the body, in the same unit."""

    values: Array
    joints: Array
    diagonal: float


def feet_on_legs(mesh: RiggedMesh, bones: dict[str, int]) -> tuple[RiggedMesh, dict[str, int]]:
    """The mesh with feet that hang on their lower legs, where the rig hangs them on its root, and its bones."""
    parents = mesh.skeleton.parents.copy()
    for upper, lower in (("knee", "ankle"), ("shin", "foot"), ("front_shin", "front_foot"), ("shin", "toe")):
        for side in "LR":
            leg, foot = bones.get(f"{upper}.{side}"), bones.get(f"{lower}.{side}")
            if leg is None or foot is None:
                continue
            line, bone = set(), foot
            while bone >= 0:
                line.add(bone)
                bone = int(parents[bone])
            if leg not in line:
                parents[foot] = leg
    old = mesh.skeleton
    order = parents_first(parents)
    turned = replace(mesh, skeleton=Skeleton(old.names, parents, old.heads, old.tails))
    place = np.argsort(order)
    return with_bones(turned, order), {name: int(place[bone]) for name, bone in bones.items()}


def turned_to_front(mesh: RiggedMesh, bones: dict[str, int]) -> RiggedMesh | None:
    """The mesh after a turn about z, so that it looks along -y; None where its bones do not say where it looks."""
    front = facing(joints_of(mesh.skeleton, bones))
    if front is None:
        return None
    # The turn that takes `front` to (0, -1).
    turn = np.array([[-front[1], front[0], 0.0], [-front[0], -front[1], 0.0], [0.0, 0.0, 1.0]])
    skeleton = mesh.skeleton.moved(turn)
    return replace(mesh, verts=mesh.verts @ turn.T, skeleton=skeleton)


def change_person(mesh: RiggedMesh, bones: dict[str, int], rng: np.random.Generator) -> RiggedMesh:
    """Other proportions and another pose, of a person that looks along -y: arms down or up, elbows and knees bent."""
    skeleton = mesh.skeleton
    count = skeleton.count
    turns = np.tile(np.eye(3), (count, 1, 1))
    heads = skeleton.heads
    for name in ("hips", "neck", "head"):
        if name in bones and rng.random() < 0.5:
            turns[bones[name]] = _turn(rng, 6.0)
    both = rng.random() < 0.6
    arms, elbows = rng.random() < 0.7, rng.random() < 0.5
    drawn = _arm_draws(rng)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        if not both:
            drawn = _arm_draws(rng)
        up, forward, bend, twist = drawn
        names = [f"{name}.{side}" for name in ("shoulder", "elbow", "wrist")]
        if not all(name in bones for name in names[:2]):
            continue
        shoulder, elbow = bones[names[0]], bones[names[1]]
        way = heads[elbow] - heads[shoulder]
        if arms:
            goal = np.array([sign * np.cos(up) * np.cos(forward), -np.cos(up) * np.sin(forward), np.sin(up)])
            turns[shoulder] = turn_between(way, goal) @ turns[shoulder]
        if elbows:
            axis = np.cross(way, np.array([0.0, -np.cos(twist), np.sin(twist)]))
            axis /= max(float(np.linalg.norm(axis)), 1e-9)
            turns[elbow] = axis_angle_to_matrix(axis[None], np.array([bend]))[0]
    legs = rng.random() < 0.5
    stride, knees = rng.normal(0, 0.15, 2), np.abs(rng.normal(0, 0.3, 2))
    spread = abs(rng.normal(0, 0.12))
    for number, (side, sign) in enumerate((("L", 1.0), ("R", -1.0))):
        if legs and f"thigh.{side}" in bones and f"knee.{side}" in bones:
            about_x, about_y = np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
            thigh = axis_angle_to_matrix(about_x, np.array([stride[number] - 0.4 * knees[number]]))[0]
            turns[bones[f"thigh.{side}"]] = axis_angle_to_matrix(about_y, np.array([-sign * spread]))[0] @ thigh
            turns[bones[f"knee.{side}"]] = axis_angle_to_matrix(about_x, knees[number : number + 1])[0]
    return moved_bones(mesh, turns, rng)


def change_quadruped(mesh: RiggedMesh, bones: dict[str, int], rng: np.random.Generator) -> RiggedMesh:
    """Other proportions and another pose, of an animal that looks along -y: neck, tail and legs turned."""
    turns = np.tile(np.eye(3), (mesh.skeleton.count, 1, 1))
    about_x, about_z = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    for name, pitch, yaw in (("neck", 25.0, 10.0), ("head", 15.0, 8.0), ("tail", 30.0, 20.0), ("hips", 4.0, 0.0)):
        if name in bones and rng.random() < 0.6:
            turn = _about(about_z, yaw * rng.normal()) @ _about(about_x, pitch * rng.normal())
            turns[bones[name]] = turn
    if rng.random() < 0.6:
        for kind in ("front_", ""):
            for side in "LR":
                swing = 12 * rng.normal()
                for joint, share in ((f"{kind}thigh", 1.0), ("front_foot" if kind else "shin", -0.7)):
                    if f"{joint}.{side}" in bones:
                        turns[bones[f"{joint}.{side}"]] = _about(about_x, share * swing)
    return moved_bones(mesh, turns, rng)


def moved_bones(mesh: RiggedMesh, turns: Array, rng: np.random.Generator) -> RiggedMesh:
    """The mesh with turned bones, and with other lengths and widths, the same on both sides."""
    skeleton = mesh.skeleton
    strength = rng.random(2)
    place = {name: index for index, name in enumerate(skeleton.names)}
    twin = np.array([min(index, place.get(mirrored_name(name), index)) for name, index in place.items()])
    stretch = np.exp(strength[0] * STRETCH * rng.normal(size=skeleton.count).clip(-2, 2))[twin]
    girth = np.exp(strength[1] * GIRTH * rng.normal(size=skeleton.count).clip(-2, 2))[twin]
    transforms = proportion_transforms(skeleton, stretch, girth, turns)
    heads, tails = joints_posed(skeleton, transforms)
    linear = np.einsum("vb,bij->vij", mesh.weights, transforms[:, :, :3])
    shift = mesh.weights @ transforms[:, :, 3]
    verts = np.einsum("vij,vj->vi", linear, mesh.verts) + shift
    loose = mesh.weights.sum(axis=1) < 0.5
    verts[loose] = mesh.verts[loose]
    sizes = np.exp(rng.normal(0, 0.07, 3)) if rng.random() < 0.7 else np.ones(3)
    new = Skeleton(skeleton.names, skeleton.parents, heads * sizes, tails * sizes)
    return replace(mesh, verts=verts * sizes, skeleton=new)


def make_example(
    mesh: RiggedMesh, bones: dict[str, int], names: tuple[str, ...], rng: np.random.Generator, yaw: float = 0.0
) -> Example:
    """A mesh that looks along -y, after a turn by `yaw` radians, as an example. names: the kind's joints, one side."""
    turn = axis_angle_to_matrix(np.array([[0.0, 0.0, 1.0]]), np.array([yaw]))[0]
    verts = mesh.verts @ turn.T
    cloud, _, _ = sample_mesh(verts, mesh.faces, mesh.corner_rgb, SPLATS, rng)
    standing = stand(body_shape(cloud), "height" if "tail" not in names else "diagonal")
    values = features(standing.shape, standing.scale)
    chosen = rng.choice(len(values), VOXELS, replace=len(values) < VOXELS)
    joints = np.full((len(both_sides(names)), 3), np.nan)
    for number, name in enumerate(both_sides(names)):
        if name in bones:
            joints[number] = (mesh.skeleton.heads[bones[name]] @ turn.T - standing.origin) / standing.scale
    return Example(values[chosen], joints, standing.diagonal / standing.scale)


def turn_between(start: Array, goal: Array) -> Array:
    """The smallest rotation (3, 3) that turns the direction start (3,) into that of goal (3,)."""
    a, b = (np.asarray(v, np.float64) / max(float(np.linalg.norm(v)), 1e-12) for v in (start, goal))
    axis = np.cross(a, b)
    angle = np.arctan2(float(np.linalg.norm(axis)), float(a @ b))
    if np.linalg.norm(axis) < 1e-9:
        if a @ b > 0:
            return np.eye(3)
        axis = np.cross(a, [1.0, 0.0, 0.0] if abs(a[0]) < 0.9 else [0.0, 1.0, 0.0])
    return np.asarray(axis_angle_to_matrix(axis / np.linalg.norm(axis), angle))


def _about(axis: Array, degrees: float) -> Array:
    return np.asarray(axis_angle_to_matrix(axis, np.array(np.radians(degrees))))


def _arm_draws(rng: np.random.Generator) -> tuple[float, float, float, float]:
    up = np.radians(rng.uniform(-85, 45) if rng.random() < 0.8 else rng.uniform(-85, -55))
    return float(up), float(rng.normal(0, 0.3)), float(rng.uniform(0, 1.7)), float(rng.uniform(-0.9, 0.9))


def _turn(rng: np.random.Generator, degrees: float) -> Array:
    return np.asarray(axis_angle_to_matrix(random_axes(1, rng), np.radians(degrees) * rng.normal(size=1))[0])
