# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin rig --rig-scale`: a rig of another unit than the splats is named, and mended where that is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.errors import InputError
from ..core.rig.rig_scale import ABSURD
from .console import print_message

if TYPE_CHECKING:
    import bpy

AUTO = "auto"


def fit_rig_scale(splats: bpy.types.Object, armature: bpy.types.Object, wanted: str | float | None) -> None:
    """Scale the rig as asked for, or say what is wrong with its size.

    A rig that looks too small may stand in a capture with surroundings: that is only said.

    Raises InputError where it is so much too large that no job can be right, or the factor to use cannot be told.
    """
    from ..scene.rig_fit import guess_rig_scale, sample_splats, scale_rig
    from ..scene.splat_object import splat_count
    from ..scene.transforms import points_in_world

    name = f"Armature '{armature.name}'"
    if isinstance(wanted, float):
        scale_rig(armature, wanted, about_world=True)
        print_message(f"{name} was scaled by {wanted:.6g}.")
    if splat_count(splats) < 2:
        return  # the job says so
    guess = guess_rig_scale(points_in_world(sample_splats(splats).points, splats), armature)
    if guess.factor == 1.0:
        if wanted == AUTO:
            print_message(f"{name} has the size of the splats, and stays as it is.")
        return
    if wanted == AUTO and guess.sure:
        scale_rig(armature, guess.factor, about_world=guess.about_world)
        print_message(f"{name} is {guess.words} for the splats, and was scaled by {guess.factor:.6g}.")
        return
    remedy = f"--rig-scale {AUTO if guess.sure else format(guess.factor, '.3g')}"
    sentence = f"{name} is {guess.words} for the splats"
    if wanted == AUTO:
        raise InputError(f"{sentence}, but no unit makes it fit; name the factor yourself.", terminal=remedy)
    if guess.factor < ABSURD:
        raise InputError(f"{sentence}; scale it.", terminal=remedy)
    doubt = ", unless these show more than it shall move" if guess.factor > 1.0 else ""
    print_message(f"Warning: {sentence}{doubt} ({remedy} scales it).")
