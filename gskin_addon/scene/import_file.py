# SPDX-License-Identifier: GPL-3.0-or-later
"""A file of splats as an object of the scene, in slices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy

from ..core.errors import GSkinError
from ..core.job.up_axis import resolve_up
from ..core.rig.skeleton import Skeleton
from ..core.splats.axes import rotate_in_place, up_rotation
from ..core.splats.cloud import SplatCloud
from ..core.splats.formats import reading
from ..core.splats.gltf_file import UP as GLTF_UP
from . import names
from .armature import read_skeleton
from .bone_frames import armature_of
from .gltf_import import bring_rig_of, is_rigged
from .placement import fits_where_it_is, place_on_floor
from .splat_object import create_splat_steps
from .steps import Steps, part_of


@dataclass(frozen=True)
class ImportOptions:
    """up: one of `UP_CHOICES`; place: stand the splats on the floor, unless an armature lies within them;
    drop_invalid: leave out splats with NaN, infinite values or a quaternion of norm 0.
    """

    up: str = "auto"
    place: bool = False
    drop_invalid: bool = False


@dataclass(frozen=True)
class Imported:
    """The object, the number of the file's splats that were left out, and what there is to say about it."""

    object: bpy.types.Object
    dropped: int
    words: str


def import_steps(
    path: Path, options: ImportOptions, armature: bpy.types.Object | None, scene: bpy.types.Scene,
    collection: bpy.types.Collection,
) -> Steps[Imported]:
    """Read a file and make an object of it. armature: one whose bones may tell where the splats belong.

    Nothing of it stays where the steps end early. Raises InputError as `read_splats`.
    """
    loaded = yield from part_of(reading(path, drop_invalid=options.drop_invalid), 0.0, 0.6)
    up, assumed = resolve_up(options.up, loaded.cloud, skeleton_of(armature), path)
    yield 0.6
    cloud = yield from part_of(rotate_in_place(loaded.cloud, up_rotation(up)), 0.6, 0.75)
    obj = yield from part_of(create_splat_steps(cloud, stem_of(path), collection=collection), 0.75, 1.0)
    obj.data[names.MARK]["up"] = up  # for advice when an armature lies along another axis
    words = [f"{path.name}: {cloud.count:,} splats, spherical harmonics of degree {cloud.sh_degree}"]
    if assumed:
        words.append(assumed)
    if up == GLTF_UP and is_rigged(path):
        words.append(bring_rig_of(path, obj, loaded.kept)[1])
    if options.place and armature_of(obj) is None:
        yield 1.0
        within = _armature_within(scene, cloud)
        if within is not None:
            words.append(f"not moved, '{within.name}' lies within them")
        else:
            place_on_floor(obj, cloud)
    words += cloud.notes
    if loaded.dropped:
        words.append(f"{loaded.dropped:,} invalid splats left out")
    return Imported(obj, loaded.dropped, "; ".join(words))


def stem_of(path: Path) -> str:
    """What the object of a file is called: its name without suffix; that of its folder for a meta.json."""
    if path.name.lower() == "meta.json":
        return path.absolute().parent.name
    return path.stem.removesuffix(".compressed")


def skeleton_of(armature: bpy.types.Object | None) -> Skeleton | None:
    """The bones that tell where the splats belong; None where the armature cannot tell (Auto-Skin says why)."""
    if armature is None:
        return None
    try:
        return read_skeleton(armature)
    except GSkinError:
        return None


def _armature_within(scene: bpy.types.Scene, cloud: SplatCloud) -> bpy.types.Object | None:
    """An armature of the scene that lies within the splats as they are."""
    for obj in scene.objects:
        skeleton = skeleton_of(obj) if obj.type == "ARMATURE" else None
        if skeleton is not None and fits_where_it_is(cloud, skeleton):
            return obj
    return None
