# SPDX-License-Identifier: GPL-3.0-or-later
"""A small figure of splats and a rig of six bones, as in ../shared/cases, bound and saved without a job."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from gskin_addon import cli
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.weights import write_weights

BONES = (
    ("spine", None, (0, 0, 0.5), (0, 0, 0.95)),
    ("head", "spine", (0, 0, 0.95), (0, 0, 1.3)),
    ("arm.L", "spine", (0.1, 0, 1.0), (0.45, 0, 1.0)),
    ("hand.L", "arm.L", (0.45, 0, 1.0), (0.8, 0, 1.0)),
    ("arm.R", "spine", (-0.1, 0, 1.0), (-0.45, 0, 1.0)),
    ("hand.R", "arm.R", (-0.45, 0, 1.0), (-0.8, 0, 1.0)),
)
"""Name, parent, head, tail."""

TURN = ("--rotate", "arm.L", "0", "-60", "0")


def cloud(each: int = 20) -> SplatCloud:
    """`each` splats along every bone."""
    rng = np.random.default_rng(3)
    along = np.linspace(0.1, 0.9, each)[:, None]
    means = np.concatenate([np.array(h) + along * (np.array(t) - h) for _, _, h, t in BONES])
    means = means + rng.normal(size=means.shape) * 0.01
    quats = rng.normal(size=(len(means), 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    count = len(means)
    sizes, opacities = rng.uniform(0.01, 0.02, (count, 3)), np.full(count, 0.9)
    return SplatCloud(means, quats, sizes, opacities, rng.normal(size=(count, 1, 3)))


def weights(each: int = 20) -> np.ndarray:
    """(N, 6): every splat of `cloud` follows its bone, in the order of BONES."""
    return np.repeat(np.eye(len(BONES), dtype=np.float32), each, axis=0)


def empty() -> None:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def add_rig(name: str = "Rig") -> Any:
    """An armature of BONES, with quaternion rotations, in the scene."""
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for bone, parent, head, tail in BONES:
        new = armature.data.edit_bones.new(bone)
        new.head, new.tail = head, tail
        new.parent = armature.data.edit_bones.get(parent) if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def add_splats(armature: Any, name: str = "fig") -> Any:
    """The figure's splats, each bound to its bone."""
    obj = create_splat_object(cloud(), name)
    write_weights(obj, armature, weights(), [bone for bone, *_ in BONES])
    return obj


def add_empty(name: str, place: tuple[float, float, float] = (0, 0, 0)) -> Any:
    obj: Any = bpy.data.objects.new(name, None)
    bpy.context.scene.collection.objects.link(obj)
    obj.location = place
    return obj


def move_to_collection(objects: list[Any], name: str = "Hidden") -> Any:
    """Put objects into a collection of their own, and into no other."""
    collection = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(collection)
    for obj in objects:
        for other in obj.users_collection:
            other.objects.unlink(obj)
        collection.objects.link(obj)
    return collection


def key(obj: Any, path: str, values: dict[int, Any], owner: Any = None, name: str = "") -> Any:
    """Keys of a property of `owner` (default: the object) at frames; gives the object's action."""
    owner = owner or obj
    for frame, value in values.items():
        setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)
    if name:
        obj.animation_data.action.name = name
    return obj.animation_data.action


def wave(armature: Any, name: str, angle: float = 1.0) -> Any:
    """An action of ten frames that turns the left arm about y."""
    quats = {1: (1, 0, 0, 0), 10: (np.cos(angle / 2), np.sin(angle / 2), 0, 0)}
    return key(armature, "rotation_quaternion", quats, armature.pose.bones["arm.L"], name)


@functools.cache
def _base() -> Path:
    """A file with the bound figure, made once: some versions of Blender need seconds to build the node groups."""
    folder = Path(tempfile.mkdtemp(prefix="gskin-figure-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    empty()
    add_splats(add_rig())
    save(folder / "base.blend")
    return folder / "base.blend"


def open_base() -> tuple[Any, Any]:
    """A fresh file with the bound figure: splats 'fig', armature 'Rig'."""
    bpy.ops.wm.open_mainfile(filepath=str(_base()))
    return bpy.data.objects["fig"], bpy.data.objects["Rig"]


def rigged(path: Path, change: Callable[[Any, Any], None] | None = None) -> Path:
    """A .blend with the bound figure, after change(splats, armature)."""
    splats, armature = open_base()
    if change is not None:
        change(splats, armature)
    save(path)
    return path


def save(path: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def posed_means(source: Path, *arguments: object) -> np.ndarray:
    """Centres (N, 3) that `gskin pose` gives; it has to succeed."""
    out = source.with_name(f"{source.stem}-{len(list(source.parent.iterdir()))}.ply")
    assert run("pose", source, "--out", out, *arguments) == 0
    return read_ply(out).cloud.means


def expected(means: np.ndarray, angle: float = -60.0, each: int = 20) -> np.ndarray:
    """The rest centres of `cloud` with the left arm turned about y at the shoulder."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    moved, head = means.copy(), np.array([0.1, 0, 1.0])
    moved[2 * each : 4 * each] = (means[2 * each : 4 * each] - head) @ turn.T + head
    return moved


def turns_in_clip(glb: Any, bone: str) -> float:
    """How much the rotation of a bone's node changes from the first to the last key of the only clip."""
    (clip,) = glb.json["animations"]
    for channel in clip["channels"]:
        if channel["target"] == {"node": glb.node(bone), "path": "rotation"}:
            values = glb.accessor(clip["samplers"][channel["sampler"]]["output"])
            return float(np.abs(values[-1] - values[0]).max())
    return 0.0


def write_figure(path: Path) -> Path:
    write_ply(path, cloud())
    return path
