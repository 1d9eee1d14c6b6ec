# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats as Blender has evaluated them, read from the points that `nodes.py` gives."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.render.drawn_splats import DrawnSplats, largest
from ...core.rig.quaternion import quat_multiply
from .. import names
from ..attributes import read_attribute, read_positions
from ..node_builder import get_input
from ..node_groups import find_display
from .nodes import EXTRA_POINTS

Array = NDArray[np.float32]
_BACK = np.array([1, -1, -1, -1], np.float32)


@dataclass(frozen=True)
class RestSplats:
    """What no pose changes, as the mesh itself has it.

    base (N, 4): constant colour and opacity; rotations (N, 4); chosen: index (M,) of the splats drawn, None for all of
    them; of these sh (M, K, 3) and opacities (M,).
    """

    base: Array
    rotations: Array
    sh: Array
    opacities: Array
    chosen: NDArray[np.int64] | None

    @property
    def count(self) -> int:
        """The number of splats, drawn or not."""
        return len(self.rotations)

    def is_same(self, other: RestSplats) -> bool:
        """Whether the same is drawn of both."""
        return _same_arrays(self, other)


def drawn_limit(obj: bpy.types.Object) -> int:
    """The most splats that the object's display draws."""
    return int(get_input(find_display(obj), "Viewport Limit"))


def read_rest(obj: bpy.types.Object, limit: int) -> RestSplats | None:
    """The rest splats of a splat object, at most `limit` of them chosen; None where attributes are missing."""
    mesh: Any = obj.data
    rotations, scales, base = (read_attribute(mesh, name) for name in (names.ROTATION, names.SCALE, names.BASE))
    if rotations is None or scales is None or base is None or base.ndim != 2 or base.shape[1] != 4:
        return None
    bands = [base[:, :3]]
    degree = int(mesh[names.MARK].get("sh_degree", 0))
    for index in range((degree + 1) ** 2 - 1):
        band = read_attribute(mesh, names.SH.format(index))
        if band is None:
            bands = bands[:1]
            break
        bands.append(band)
    opacities = np.clip(base[:, 3], 0.0, 1.0)
    chosen = largest(scales, opacities, limit)
    part = slice(None) if chosen is None else chosen
    sh = np.stack([band[part] for band in bands], axis=1)
    return RestSplats(base, rotations, sh, opacities[part], chosen)


def read_edited_rest(evaluated: bpy.types.Object, known: RestSplats | None, limit: int) -> RestSplats | None:
    """The rest splats of an object in Edit Mode, whose own mesh cannot be read: those `known` from before if they are
    still there, else what its evaluated points tell, which is the colour of no direction; None as `read_posed`."""
    given = _given(evaluated)
    if given is None:
        return None
    base, rotations, scales = (read_attribute(given[0], name) for name in (names.BASE, names.ROTATION, names.SCALE))
    base, rotations, scales = base[: given[1]], rotations[: given[1]], scales[: given[1]]
    if known is not None and np.array_equal(base, known.base):
        return known
    opacities = np.clip(base[:, 3], 0.0, 1.0)
    chosen = largest(scales, opacities, limit)
    part = slice(None) if chosen is None else chosen
    return RestSplats(base, rotations, base[part, None, :3], opacities[part], chosen)


def posed_positions(evaluated: bpy.types.Object) -> Array | None:
    """(N, 3) where all splats of an evaluated object are, drawn or not, in its own space; None as `read_posed`."""
    given = _given(evaluated)
    return None if given is None else read_positions(given[0])[: given[1]]


def _given(evaluated: bpy.types.Object) -> tuple[Any, int] | None:
    """The mesh that an evaluated object's display gives the shader, and its number of splats."""
    mesh: Any = evaluated.data
    count = len(mesh.vertices) - EXTRA_POINTS
    named = {attribute.name for attribute in mesh.attributes}
    whole = {names.BASE, names.ROTATION, names.SCALE} <= named and len(mesh.edges) == 1 and count >= 0
    return (mesh, count) if whole else None


def read_posed(
    evaluated: bpy.types.Object, rest: RestSplats, limit: int, hidden: NDArray[np.bool_] | None = None
) -> DrawnSplats | None:
    """The splats of an evaluated object; None where its display gives no points for the shader (yet).

    Where modifiers of other people have left out or added splats, they have the colour of no direction. hidden (N,):
    splats that are not to be seen.
    """
    given = _given(evaluated)
    if given is None:
        return None
    mesh, count = given
    rotations, scales = (read_attribute(mesh, name) for name in (names.ROTATION, names.SCALE))
    points, rotations, scales = read_positions(mesh)[:count], rotations[:count], scales[:count]
    scales = np.maximum(scales * np.float32(get_input(find_display(evaluated), "Size")), np.float32(0.0))
    turns, special = read_attribute(mesh, names.TURN), read_attribute(mesh, names.COLOR)
    colors = None if special is None else _encoded(special[:count, :3])
    if count != rest.count:
        base = read_attribute(mesh, names.BASE)[:count]
        sh, opacities = base[:, None, :3], np.clip(base[:, 3], 0.0, 1.0)
        every = DrawnSplats(points, rotations, scales, opacities, sh, colors=colors)
        part = largest(scales, opacities, limit)
        return every if part is None else every.select(part)
    chosen = slice(None) if rest.chosen is None else rest.chosen
    if rest.sh.shape[1] == 1:
        turns = None
    elif turns is not None:
        turns = turns[:count][chosen]
    else:
        turns = quat_multiply(rotations[chosen], rest.rotations[chosen] * _BACK).astype(np.float32)
    colors = None if colors is None else colors[chosen]
    opacities = rest.opacities
    if hidden is not None and len(hidden) == count:
        opacities = np.where(hidden[chosen], np.float32(0.0), opacities)
    return DrawnSplats(points[chosen], rotations[chosen], scales[chosen], opacities, rest.sh, turns, colors)


def is_same(one: DrawnSplats, other: DrawnSplats) -> bool:
    """Whether both are drawn the same, but for the matrix."""
    return _same_arrays(replace(one, matrix=other.matrix), other)


def _same_arrays(one: Any, other: Any) -> bool:
    for field in fields(one):
        mine, others = getattr(one, field.name), getattr(other, field.name)
        if mine is not others and (mine is None or others is None or not np.array_equal(mine, others)):
            return False
    return True


def _encoded(linear: Array) -> Array:
    """sRGB of linear colours."""
    low = np.clip(linear, 0.0, None)
    return np.where(low <= 0.0031308, 12.92 * low, 1.055 * np.power(low, 1 / 2.4) - 0.055).astype(np.float32)
