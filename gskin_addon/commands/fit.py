# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin fit`: a skeleton fitted to splats, or one of another program brought into them, as a file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import InputError
from ..core.files import write_text
from ..core.job.up_axis import AUTO, resolve_up
from ..core.rig.skeleton import Skeleton
from ..core.skeleton.fit import Fit, fit
from ..core.skeleton.placing import guess_placing
from ..core.skeleton.read import READERS, read_skeleton_file
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.cloud import SplatCloud
from .blender import require_bpy
from .console import print_message
from .paths import check_output, same_file
from .rig import read_splats

if TYPE_CHECKING:
    import bpy


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    check_output(options.out, "--out", (".blend", ".json"))
    given = [path for path in (options.splats, options.skeleton) if path is not None]
    if any(same_file(path, options.out) for path in given):
        raise InputError(f"--out '{options.out}' would overwrite its own input; choose another name.")
    if (options.kind is None) == (options.skeleton is None):
        raise InputError("Say what to fit: --kind human, or --skeleton FILE of another program; one of the two.")
    if options.skeleton is not None and options.landmark:
        raise InputError("--landmark is for --kind; a skeleton from a file is only turned, scaled and moved.")
    as_json = options.out.suffix.lower() == ".json"
    needs_blender = options.skeleton is not None and options.skeleton.suffix.lower() not in READERS
    if as_json and needs_blender:
        raise InputError(f"A '{options.skeleton.suffix}' needs Blender's importers; choose --out RIG.blend.")
    cloud, up = standing_splats(options.splats, options.up, options.drop_invalid)
    if not as_json:
        require_bpy()
        from ..scene import rig_files

        rig_files.empty_scene()
    splats = None if as_json else _splat_object(cloud, options.splats.stem, up)
    if options.skeleton is not None:
        skeleton = _bring(options.skeleton, cloud, splats)
    else:
        found = fit_kind(options.kind, cloud, options)
        skeleton = found.placed()
        if splats is not None:
            make_rig(found, splats.name, rigify=options.rigify)
    if as_json:
        write_text(options.out, skeleton.to_json() + "\n")
    else:
        rig_files.save_blend(options.out)
    print_message(f"{skeleton.count} bones, in '{options.out}'.")


def standing_splats(path: Path, up: str | None, drop_invalid: bool) -> tuple[SplatCloud, str]:
    """The splats of a file in Blender's axes, and which of theirs was up; says what was assumed."""
    cloud = read_splats(path, drop_invalid)
    axis, assumed = resolve_up(up or AUTO, cloud, None, path)
    if assumed:
        print_message(f"'{path}': {assumed}.")
    return rotate_cloud(cloud, up_rotation(axis)), axis


def fit_kind(kind: str, cloud: SplatCloud, options: argparse.Namespace) -> Fit:
    """The fit that the options ask for; says where it is unsure."""
    landmarks = {}
    for name, *place in options.landmark:
        try:
            landmarks[name] = np.array([float(number) for number in place])
        except ValueError:
            raise InputError(f"--landmark {name}: '{' '.join(place)}' are not three numbers.") from None
    found = fit(
        kind,
        cloud,
        front=options.looks_to,
        alike={"alike": True, "apart": False}.get(options.sides),
        landmarks=landmarks,
    )
    if not found.front_sure:
        print_message("Warning: it is not clear to where the body looks; look at the fit, or say it with --looks-to.")
    elif found.unsure:
        print_message("Warning: the fit is unsure; look at it, and name ends of the body with --landmark.")
    return found


def make_rig(found: Fit, name: str, *, rigify: bool) -> bpy.types.Object:
    """The armature of a fit; a metarig of Rigify, for this process only, if so wished."""
    from ..scene.fitted_rig import create_fitted_rig, turn_rigify_on

    if rigify and not turn_rigify_on():
        print_message("Rigify is not here; the armature has its bones but none of its settings.")
    return create_fitted_rig(found, f"{name} Skeleton")


def _splat_object(cloud: SplatCloud, name: str, up: str) -> bpy.types.Object:
    from ..scene import names
    from ..scene.splat_object import create_splat_object

    splats = create_splat_object(cloud, name)
    splats.data[names.MARK]["up"] = up
    return splats


def _bring(path: Path, cloud: SplatCloud, splats: bpy.types.Object | None) -> Skeleton:
    """The skeleton of a file in the splats, with an armature of it where there is a scene."""
    if splats is None:
        skeleton = read_skeleton_file(path)
        placing = guess_placing(skeleton, cloud.means)
        skeleton = placing.of(skeleton)
    else:
        from ..scene.armature import read_skeleton
        from ..scene.import_skeleton import import_skeleton

        armature, guessed = import_skeleton(path, splats)
        skeleton = read_skeleton(armature)
        assert guessed is not None
        placing = guessed
    if placing.plain:
        print_message(f"'{path}': {placing.plain} ({placing.scale:.4g} of its size).")
    if placing.unsure:
        print_message(f"Warning: '{path}' does not lie well in the splats; check its size, axes and place.")
    elif placing.either_way:
        print_message(f"Warning: '{path}' would fit as well turned about; check that its front is the body's.")
    return skeleton
