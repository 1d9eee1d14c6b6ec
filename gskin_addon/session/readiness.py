# SPDX-License-Identifier: GPL-3.0-or-later
"""What is looked at before Auto-Skin runs: a list of checks, each with the click that mends what it found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import bpy
import numpy as np

from ..core.errors import InputError
from ..core.job.checks import APART, SOUND, better_axis, check_overlap, overlap
from ..core.rig.rig_scale import ABSURD
from ..core.rig.skeleton import Skeleton
from ..scene.armature import rig_similarity
from ..scene.follow_transforms import warning_of
from ..scene.modifier_stack import blind
from ..scene.native_nodes import POSITION_STEPS
from ..scene.node_groups import draws_native
from ..scene.placement import is_placed, shift_of, up_of
from ..scene.proxy_object import followed_armature
from ..scene.rig_fit import SplatSample, guess_rig_scale, rest_skeleton, sample_splats
from ..scene.single_user import sharers
from ..scene.splat_object import splat_count
from ..scene.transforms import points_in_world, similarity_as_shown
from . import learning_runtime
from .chosen import chosen_armature, chosen_blender_splats, chosen_splats, panel_settings
from .preferences import job_python, worker_python
from .running_job import state

State = Literal["ok", "warn", "stop"]

STRAYS = 0.002
"""Share of stray splats that is worth a word."""
COARSE = 0.5
"""Steps of drawn positions, in standard deviations of a splat, from which a picture shows them."""


@dataclass(frozen=True)
class Check:
    """One look at splats and rig.

    name: what was looked at; state: "stop" keeps Auto-Skin from running; sentence: what was found ("" where ok);
    operator, label: the click that mends it and its button, "" where there is none; options: the operator's.
    """

    name: str
    state: State = "ok"
    sentence: str = ""
    operator: str = ""
    label: str = ""
    options: tuple[tuple[str, Any], ...] = ()


MODE = "Mode"
"""Name of the check that nothing is in Edit Mode."""

_samples: dict[tuple[Any, ...], SplatSample] = {}
_fits: dict[tuple[Any, ...], list[Check]] = {}
_KEPT = 8


def checks(context: bpy.types.Context) -> list[Check]:
    """All checks of the chosen objects, in the order to mend them in. Quick: panels ask on every redraw."""
    splats, armature = chosen_splats(context), chosen_armature(context)
    found = [_splats_check(context, splats), _armature_check(context, armature)]
    if splats is not None and armature is not None:
        found += [_mode_check(splats, armature), _scale_check(splats, armature), *_transform_checks(splats)]
        if all(check.state == "ok" for check in found):
            found += _fit_checks(splats, armature)
        found += [_owner_check(splats, armature), *_deform_checks(splats)]
    found.append(_python_check(context))
    return found


def what_is_missing(context: bpy.types.Context, *, in_edit_mode: bool = False) -> str:
    """What a person must do before Auto-Skin can run, or nothing. Quick: menus ask on every redraw.

    in_edit_mode: Edit Mode is no obstacle, whoever asks leaves it.
    """
    if state.job is not None:
        return "Auto-Skin is running: wait for it or cancel it"
    stops = (check for check in checks(context) if check.state == "stop")
    return next((check.sentence for check in stops if not (in_edit_mode and check.name == MODE)), "")


def guidance_remedy(context: bpy.types.Context) -> learning_runtime.Remedy | None:
    """What keeps guidance from computing, and the click that mends it; None where a Python with torch is at hand."""
    return None if worker_python(context)[0] is not None else learning_runtime.remedy(context)


def look_at(splats: bpy.types.Object) -> None:
    """Take the sample of just imported splats, so that the first redraw need not."""
    if splat_count(splats) >= 2:
        _remember(_samples, _shape_of(splats), lambda: sample_splats(splats))


def forget() -> None:
    """Look at splats and rig anew at the next question."""
    _samples.clear()
    _fits.clear()


def _splats_check(context: bpy.types.Context, splats: bpy.types.Object | None) -> Check:
    blenders = chosen_blender_splats(context)
    if blenders is not None:
        sentence = (
            f"'{blenders.name}' holds Blender's own splats, which no armature moves: Auto-Skin first makes them a mesh "
            "of the same splats (undo brings them back)"
        )
        return Check("Splats", "warn", sentence, "gskin.make_riggable", "Make Riggable")
    if splats is None:
        sentence = "No splats are chosen: import a Gaussian splat .ply, or select a splat object"
        return Check("Splats", "stop", sentence, "gskin.import_splats", "Import Splats...")
    return Check("Splats")


def _armature_check(context: bpy.types.Context, armature: bpy.types.Object | None) -> Check:
    if armature is None:
        instanced = _instanced(context)
        if instanced:
            return Check("Armature", "stop", instanced)
        return Check("Armature", "stop", "No armature is chosen: add one, or select it")
    if not any(bone.use_deform for bone in armature.data.bones):
        sentence = f"Armature '{armature.name}' has no deform bones: turn on Deform for some"
        if not armature.data.bones or armature.mode == "EDIT":
            return Check("Armature", "stop", sentence)
        return Check("Armature", "stop", sentence, "gskin.enable_deform", "Let All Bones Deform")
    return Check("Armature")


def _instanced(context: bpy.types.Context) -> str:
    """Where an armature is in the scene only as part of an instanced collection, what to do about it."""
    for obj in context.scene.objects:
        collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        rig = None if collection is None else next((o for o in collection.all_objects if o.type == "ARMATURE"), None)
        if rig is not None:
            linked = "Object > Library Override > Make"
            how = linked if rig.library is not None else "Object > Apply > Make Instances Real"
            return f"Armature '{rig.name}' is only in the instance '{obj.name}': {how}"
    return ""


def _owner_check(splats: bpy.types.Object, armature: bpy.types.Object) -> Check:
    """Whether the splats can be written to, and only theirs are."""
    if splats.library is not None or splats.data.library is not None:
        sentence = f"'{splats.name}' is linked from another file: make it local (Object > Relations)"
        return Check("Owner", "stop", sentence)
    others = sharers(splats)
    if others:
        sentence = f"'{splats.name}' shares its mesh with '{others[0]}', and will get one of its own"
        return Check("Owner", "warn", sentence)
    if armature.library is not None:
        sentence = f"Armature '{armature.name}' is linked: to pose it, make it local (Object > Relations)"
        return Check("Owner", "warn", sentence)
    return Check("Owner")


def _mode_check(splats: bpy.types.Object, armature: bpy.types.Object) -> Check:
    if splats.mode == "EDIT" or armature.mode == "EDIT":
        sentence = "An object is in Edit Mode: leave it (Tab)"
        return Check(MODE, "stop", sentence, "object.mode_set", "Leave Edit Mode", (("mode", "OBJECT"),))
    return Check(MODE)


def _scale_check(splats: bpy.types.Object, armature: bpy.types.Object) -> Check:
    try:
        similarity_as_shown(splats)
        rig_similarity(armature, as_shown=True)
    except InputError as error:
        return Check("Scale", "stop", error.plain, "gskin.even_scale", "Make the Scale Even")
    return Check("Scale")


def _transform_checks(splats: bpy.types.Object) -> list[Check]:
    warning = warning_of(splats)
    return [Check("Applied Transform", "warn", warning)] if warning else []


def _deform_checks(splats: bpy.types.Object) -> list[Check]:
    """What moves splats and never turns them; all other modifiers are followed (`scene/probes.py`)."""
    names = blind(splats)
    if not names:
        return []
    sentence = f"Modifier '{names[0]}' moves splats and turns none of them: it does not ask where they are"
    return [Check("Deformation", "warn", sentence)]


def _fit_checks(splats: bpy.types.Object, armature: bpy.types.Object) -> list[Check]:
    """Size, place and direction of the rig in the splats, and strays; remembered until either changes."""
    if splat_count(splats) < 2:
        return []
    rig = [(*b.head_local, *b.tail_local, b.use_deform) for b in armature.data.bones]
    matrices = tuple(np.array(obj.matrix_world).tobytes() for obj in (splats, armature))
    bound = followed_armature(splats) is not None or splats.parent is not None
    shape = _shape_of(splats)
    names = splats.name, armature.name, up_of(splats), bound, is_placed(splats)
    key = (shape, armature.session_uid, matrices, names, hash(tuple(rig)))
    if key not in _fits:
        sample = _remember(_samples, shape, lambda: sample_splats(splats))
        _remember(_fits, key, lambda: _look(splats, armature, sample, bound))
    return _fits[key]


def _shape_of(splats: bpy.types.Object) -> tuple[Any, ...]:
    """What tells that the splats are where they were in their object."""
    mesh: Any = splats.data
    count = len(mesh.vertices)
    some = tuple(tuple(mesh.vertices[i].co) for i in range(0, count, max(1, count // 8)))
    return mesh.session_uid, count, some


def _remember(kept: dict[tuple[Any, ...], Any], key: tuple[Any, ...], make: Any) -> Any:
    if key not in kept:
        while len(kept) >= _KEPT:
            del kept[next(iter(kept))]
        kept[key] = make()
    return kept[key]


def _look(
    splats: bpy.types.Object, armature: bpy.types.Object, sample: SplatSample, bound: bool
) -> list[Check]:
    points, skeleton = points_in_world(sample.points, splats), rest_skeleton(armature)
    found = [_size_check(points, skeleton, armature, bound)]
    # A rig of a wrong size lies elsewhere, too: the place is looked at when the size will do.
    if found[0].state != "stop":
        found.append(_place_check(splats, armature, points, skeleton, bound))
    step = sample.reach / POSITION_STEPS
    if sample.size > 0 and step > COARSE * sample.size and draws_native(splats):
        sentence = (
            f"A few splats lie so far off that Blender draws all others in steps of {step:.2g} (it divides the whole "
            "extent evenly), coarser than the splats: put the far ones aside"
        )
        found.append(Check("Far Splats", "warn", sentence, "gskin.clean_splats", "Put Them Aside"))
    if sample.strays >= STRAYS:
        sentence = "Some splats lie off the body, and would follow bones that they have nothing to do with"
        found.append(Check("Strays", "warn", sentence, "gskin.clean_splats", "Put Them Aside"))
    else:
        found.append(Check("Strays"))
    return found


def _size_check(points: Any, skeleton: Skeleton, armature: bpy.types.Object, bound: bool) -> Check:
    guess = guess_rig_scale(points, armature)
    if guess.factor == 1.0:
        return Check("Size")
    factor = guess.factor
    doubt = "" if guess.sure or factor < 1.0 else ", unless they show more than it shall move"
    sentence = f"Armature '{armature.name}' is {guess.words} for the splats{doubt}"
    level: State = "stop" if factor < ABSURD else "warn"
    if overlap(points, skeleton) < APART:
        level, sentence = "stop", f"{sentence}, and does not overlap them"
    if bound:
        return Check("Size", level, sentence)
    return Check("Size", level, sentence, "gskin.fix_rig_scale", f"Scale the Rig by {factor:.3g}")


def _place_check(
    splats: bpy.types.Object, armature: bpy.types.Object, points: Any, skeleton: Skeleton, bound: bool
) -> Check:
    try:
        check_overlap(points, skeleton, f"'{splats.name}'", f"Armature '{armature.name}'", up_of(splats))
    except InputError as error:
        if bound:
            return Check("Place", "stop", error.plain)
        shift = shift_of(splats)
        if shift.any() and overlap(points - shift, skeleton) >= SOUND:
            return Check("Place", "stop", error.plain, "gskin.move_rig_to_splats", "Move the Rig to the Splats")
        _, best, _ = better_axis(points, skeleton, up_of(splats))
        if best:
            return Check("Place", "stop", error.plain, "gskin.turn_up", f"Turn {best.upper()} Up", (("up", best),))
        return Check("Place", "stop", error.plain, "gskin.center_rig", "Move the Rig into the Splats")
    return Check("Place")


def _python_check(context: bpy.types.Context) -> Check:
    needs_runtime = panel_settings(context).needs_runtime()
    problem = job_python(context, needs_runtime)[1]
    if not problem:
        return Check("Learning Runtime" if needs_runtime else "Python")
    remedy = guidance_remedy(context) if needs_runtime else None
    if remedy is None:
        return Check("Python", "stop", problem)
    return Check("Learning Runtime", "stop", problem, remedy.operator, remedy.label)
