# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin weights`: change the weights of rigged splats, step by step in the order given."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.skinning.edits.assign import flood, limit, normalise, to_bone
from ..core.skinning.edits.blend import follow_neighbours, sharpen, smooth
from ..core.skinning.edits.body_graph import BodyGraph, body_graph
from ..core.skinning.edits.mirror import mirror
from ..core.skinning.transfer.transfer import Shape, transfer
from .blender import require_bpy
from .console import print_message
from .paths import check_output, same_file
from .save import save_rigged
from .selection import read_selection
from .weight_sources import SOURCES, Source, read_source, write_for_mesh

if TYPE_CHECKING:
    import bpy

Array = NDArray[Any]
Change = Callable[[Array], Array]


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    mesh, mesh_out = options.to_mesh or (None, None)
    outputs = [path for path in (options.out, options.weights, mesh_out) if path is not None]
    if not outputs:
        raise InputError("Say where to: --out FILE for the splats, --weights W.npz for the weights alone.")
    if mesh_out is not None:
        check_output(mesh_out, "--to-mesh", (".npz", ".txt", ".glb"))
    if options.out is not None:
        check_output(options.out, "--out", (".blend", ".glb"))
    if options.weights is not None:
        check_output(options.weights, "--weights", (".npz", ".txt"))
    if not options.changes and mesh_out is None:
        raise InputError("Nothing to do; say what to change, for instance --smooth 5 (gskin weights --help).")
    if options.source.suffix.lower() != ".blend":
        raise InputError(f"'{options.source}' is no .blend; give one that `gskin rig` wrote.")
    if options.out is not None and same_file(options.source, options.out):
        raise InputError(f"--out '{options.out}' would overwrite its own input; choose another name.")
    require_bpy()
    from ..scene import rig_files
    from ..scene.armature import deform_bone_names
    from ..scene.blend_rigs import check_whole
    from ..scene.bone_frames import armature_of
    from ..scene.single_user import said_of, sharers
    from ..scene.steps import run_to_end
    from ..scene.weight_edits import iter_edit_weights

    # Other files are read first: a .blend takes the place of the one that is open.
    options.changes = [
        (option, read_source(option, value, options.mesh_up) if option in SOURCES else value)
        for option, value in options.changes
    ]
    rig_files.open_blend(options.source)
    obj = rig_files.find_splats(options.source, options.object)
    armature = armature_of(obj)
    if armature is None:
        raise InputError(
            f"'{obj.name}' in '{options.source}' follows no armature by weights of its own; bind it with gskin rig."
        )
    check_whole(armature)
    bones = deform_bone_names(armature)
    for name in options.lock:
        _column(name, bones, "--lock")
    selected = _selection(options, obj, bones)
    body, others = _Body(obj, armature), sharers(obj)
    how = {"reach": options.reach, "angle": options.angle, "inpaint": options.inpaint, "fit": options.fit}
    for option, value in options.changes:
        change, reached = _change(option, value, body, bones, selected, options.rim, how)
        even = option in ("limit", "normalise")
        count = run_to_end(iter_edit_weights(obj, change, reached, lock=options.lock, even=even))
        words = f"--{option.replace('_', '-')}: weights of {count:,} splats changed"
        print_message("; ".join([words, *body.notes]) + ".")
        body.notes.clear()
    if len(sharers(obj)) < len(others):
        print_message(f"{said_of(obj, others)}.")
    if options.weights is not None:
        from ..scene.save_weights import save_weights

        save_weights(obj, options.weights)
    if mesh is not None and mesh_out is not None:
        write_for_mesh(mesh, mesh_out, obj, body.shape(), body.skeleton, options.mesh_up, how)
    if options.out is not None:
        save_rigged(options.out, obj)
    print_message(f"Written: {' and '.join(repr(str(path)) for path in outputs)}.")


class _Body:
    """What changes need to know of the splats besides their weights; made once, when it is asked for."""

    def __init__(self, obj: bpy.types.Object, armature: bpy.types.Object) -> None:
        from ..scene.armature import read_skeleton
        from ..scene.seams import read_seams
        from ..scene.splat_object import read_cloud

        self.cloud, self.sides = read_cloud(obj), read_seams(obj)
        self.means = self.cloud.means
        self.skeleton = read_skeleton(armature)
        self.notes: list[str] = []
        self._graph: BodyGraph | None = None
        self._shape: Shape | None = None

    def graph(self) -> BodyGraph:
        """The graph of the body."""
        if self._graph is None:
            self._graph = body_graph(self.means, walls=self.sides)
        return self._graph

    def shape(self) -> Shape:
        """What a transfer needs of the splats."""
        if self._shape is None:
            self._shape = Shape.of_splats(self.cloud, self.sides)
        return self._shape


def _change(
    option: str,
    value: Any,
    body: _Body,
    bones: list[str],
    selected: Array | None,
    rim: float,
    how: dict[str, Any],
) -> tuple[Change, Array | None]:
    """The function of an option, and the splats that it may change."""
    if option in ("to_bone", "flood", "follow_neighbours") and selected is None:
        raise InputError(
            f"--{option.replace('_', '-')} is for some splats alone; name them with --select or --select-bone."
        )
    chosen = np.ones(len(body.means), bool) if selected is None else selected
    if option in SOURCES:
        return lambda _: _taken(body, value, bones, how), selected
    if option == "smooth":
        return lambda w: smooth(w, body.graph(), selected=selected, repeat=value), selected
    if option == "sharpen":
        return lambda w: sharpen(w, value), selected
    if option == "limit":
        return lambda w: limit(w, value), selected
    if option == "normalise":
        return normalise, selected
    if option == "to_bone":
        bone = _column(value, bones, "--to-bone")
        reached = None if rim > 0 else chosen
        return lambda w: to_bone(w, bone, chosen, rim=rim, graph=body.graph() if rim > 0 else None), reached
    if option == "flood":
        bone, weight = _column(value[0], bones, "--flood"), value[1]
        return lambda w: flood(w, bone, weight, chosen), selected
    if option == "follow_neighbours":
        return lambda w: _noted(body, follow_neighbours(w, body.graph(), chosen), "nothing around them"), selected
    return (
        lambda w: _noted(body, mirror(w, body.means, body.skeleton, source=value, selected=selected), "no other side"),
        selected,
    )


def _taken(body: _Body, source: Source, bones: list[str], how: dict[str, Any]) -> Array:
    """Weights from another file, with notes about what was not simply taken over."""
    weights, note = source.for_bones(bones)
    if note:
        body.notes.append(note)
    result = transfer(source.shape, weights, body.shape(), **how)
    filled = int((~result.taken).sum())
    if filled:
        body.notes.append(f"{filled:,} had no match and were filled in from around them")
    return result.weights


def _noted(body: _Body, result: tuple[Array, Array], why: str) -> Array:
    after, alone = result
    if alone.any():
        body.notes.append(f"{int(alone.sum()):,} have {why} and stay")
    return after


def _selection(options: argparse.Namespace, obj: bpy.types.Object, bones: list[str]) -> Array | None:
    """(N,) bool from --select and --select-bone together; None where neither is given."""
    if options.select is None and not options.select_bone:
        return None
    from ..scene.weights import read_weights

    weights, _ = read_weights(obj, bones)
    selected = np.zeros(len(weights), bool)
    if options.select is not None:
        selected[read_selection(options.select, len(weights))] = True
    for name in options.select_bone:
        column = _column(name, bones, "--select-bone")
        selected |= (weights.argmax(axis=1) == column) & (weights[:, column] > 0)
    if not selected.any():
        raise InputError("No splats are selected: no splat follows those bones most; choose other bones.")
    return selected


def _column(name: str, bones: list[str], option: str) -> int:
    if name not in bones:
        listed = ", ".join(bones[:8]) + (", ..." if len(bones) > 8 else "")
        raise InputError(f"{option} '{name}': the armature has no such deform bone; it has {listed}.")
    return bones.index(name)
