# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigged splats in glTF: a part of Blender's own exporter, and one function that exports a .glb.

Blender's exporter writes armature, skin, animations and the splats' positions and weights; the class below,
which the exporter finds in the add-on, adds what KHR_gaussian_splatting asks for. See `docs/gltf.md`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import GSkinError, InputError
from ..core.files import replaced
from ..core.splats import gltf
from ..core.splats.axes import rotate_cloud
from ..core.splats.cloud import SplatCloud
from .actions import left_to_guess, own_parts
from .bone_frames import armature_of
from .clip_losses import listed, lost_in_clips, moved_without_joints, said_of_nla
from .deform_stack import NO_BENDS, lost_in_gltf
from .frames import frame_of, go_to
from .gltf_bends import bends_as_joints, can_be_joints, idle_groups, idle_groups_aside
from .gltf_clips import clips_of, keep_own, play_companions, rest_before_clips
from .gltf_shear import said_of_shear, shear_watched, sheared_carriers
from .nodes_aside import hide_nodes, nodes_hidden, show_nodes
from .splat_object import is_splat_object, read_cloud
from .visibility import shown

_EXPORTER = "io_scene_gltf2"

class SplatExport:
    """Hooks of Blender's glTF exporter; one instance per export.

    Independent of Blender's version and of the dialog's options: splats are always written as points, from
    the mesh before Geometry Nodes.
    """

    def __init__(self) -> None:
        self._object: bpy.types.Object | None = None
        self._options: dict[str, Any] = {}

    def pre_export_hook(self, export_settings: dict[str, Any]) -> None:
        """Switch off the splats' node groups: their instances would hide the points and the skin."""
        self._options = {name: export_settings.get(name) for name in ("gltf_loose_points", "gltf_apply")}
        if _ours:
            return  # what is hidden then, and comes back, is in `export_glb`
        hide_nodes()
        # post_export_hook is not called when the exporter fails.
        bpy.app.timers.register(show_nodes, first_interval=0.0)

    def post_export_hook(self, export_settings: dict[str, Any]) -> None:
        """Switch them on again."""
        if not _ours:
            show_nodes()

    def gather_node_mesh_hook(
        self, option: Any, blender_object: Any, export_settings: dict[str, Any]
    ) -> None:
        """Before each object's mesh: choose the options that splats need, for splats only."""
        splats = is_splat_object(blender_object)
        self._object = blender_object if splats else None
        export_settings["gltf_loose_points"] = splats or self._options["gltf_loose_points"]
        export_settings["gltf_apply"] = False if splats else self._options["gltf_apply"]

    def gather_actions_hook(self, blender_object: Any, gathered: Any, export_settings: dict[str, Any]) -> None:
        """An armature that moves splats is given no clips of others."""
        if _moves_splats(blender_object):
            keep_own(blender_object, gathered)

    def animation_switch_loop_hook(self, blender_object: Any, post: bool, export_settings: dict[str, Any]) -> None:
        """Before, and after, all clips of an object are sampled."""
        if not post:
            rest_before_clips(blender_object)

    def pre_animation_switch_hook(self, blender_object: Any, blender_action: Any, *_: Any) -> None:
        """Before a clip is sampled."""
        play_companions(blender_object, blender_action)

    def gather_gltf_hook(self, active: int, scenes: Any, animations: Any, export_settings: dict[str, Any]) -> None:
        """When all is gathered: skinned splats become roots of their scene, their skins name the armature's node.

        Blender hangs a skinned mesh under its armature. The positions are in world space, so whoever does not know
        skins must not apply the armature's transform to them a second time.
        """
        for scene in scenes:
            _make_roots(scene)

    def gather_mesh_hook(
        self,
        gltf2_mesh: Any,
        blender_mesh: Any,
        blender_object: Any,
        vertex_groups: Any,
        modifiers: Any,
        materials: Any,
        export_settings: dict[str, Any],
    ) -> None:
        """Turn the exporter's points into splats."""
        if self._object is None or blender_mesh != self._object.data:
            return
        try:
            # A skinned mesh is stored in world space, any other in its object's.
            skinned = any(name.startswith("JOINTS_") for name in gltf2_mesh.primitives[0].attributes)
            cloud = read_cloud(self._object, world=skinned)
            if export_settings["gltf_yup"]:
                cloud = rotate_cloud(cloud, gltf.blender_to_gltf())
            _add_splats(gltf2_mesh, cloud)
            armature = armature_of(self._object)
            doubts = [] if armature is None else [*left_to_guess(armature), *said_of_nla(armature)]
            idle = idle_groups(self._object)
            if idle:
                doubts.append(f"{listed(idle)} of '{armature.name}' do not deform here, and do in the file.")
            for sentence in doubts + lost_in_gltf(self._object):
                ours = " GSkin's own export has them as joints." if sentence.startswith(NO_BENDS) else ""
                export_settings["log"].warning(sentence + ours)
        except GSkinError as error:
            export_settings["log"].error(error.plain, popup=True)
            _failures.append(error)


_ours: list[Path] = []
"""The file that `export_glb` writes, while it runs."""
_failures: list[GSkinError] = []
"""Errors of the running export; the exporter itself only prints what happens in a hook."""


def export_glb(
    path: str | os.PathLike[str],
    objects: Sequence[bpy.types.Object],
    *,
    deform_bones_only: bool = False,
    animations: bool = True,
    posed: bool = False,
) -> list[str]:
    """Export splat objects, with the armatures they follow and their actions, as one .glb.

    Gives sentences about what is lost in it: what glTF has no word for.

    Further objects in `objects` are exported as Blender does. The file appears at `path` when it is complete.
    posed: the joints stand as the bones do now, and not at rest, also where there are clips.

    Raises InputError: no splat object, not a .glb name, no such folder, an object not in the scene or not
    selectable, non-uniform object scale; GSkinError where the exporter fails or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".glb":
        raise InputError(f"'{path}' does not end in .glb; choose such a name.")
    if not path.parent.is_dir():
        raise InputError(f"'{path.parent}' is no folder; create it or choose another one.")
    if not any(is_splat_object(obj) for obj in objects):
        raise InputError(f"'{path}': there are no splats among the objects to export; choose a splat object.")
    armatures = list(dict.fromkeys(a for obj in objects if (a := armature_of(obj)) is not None))
    frame = frame_of(bpy.context.scene)
    free: dict[str, list[str]] = {}
    try:
        with (
            replaced(path, ".glb") as temporary,
            shown([*_seen(objects), *armatures], select=True),
            _selected([*objects, *armatures]),
            _discoverable(),
            _by_ourselves(path),
            nodes_hidden(),
            idle_groups_aside(objects),
        ):
            while True:
                with (
                    clips_of(armatures, posed=posed, animations=animations) as options,
                    bends_as_joints(objects, free) as made,
                    shear_watched(armatures) as sheared,
                ):
                    _export(temporary, deform_bones_only, animations, made.most, options)
                wrong = sheared_carriers(objects, sheared, made.bones, free)
                changeable = {rig.name for rig in armatures if can_be_joints(rig)}
                if free or not changeable.intersection(wrong):
                    break
                # What is sheared somewhere is known once all frames were sampled: once more, with stand-ins for that.
                free = {name: bones for name, bones in wrong.items() if name in changeable}
    except RuntimeError as error:
        if _failures:
            raise _failures[0] from error
        raise GSkinError(f"'{path}': Blender's glTF exporter failed ({_last_error(error)}).") from error
    finally:
        # The exporter moves to frame 0 and stays there when it fails.
        if frame_of(bpy.context.scene) != frame:
            go_to(bpy.context.scene, frame)
    clipped = [armature for armature in armatures if animations]
    doubts = [sentence for armature in clipped for sentence in left_to_guess(armature)]
    doubts += [s for armature in clipped if own_parts(armature) for s in lost_in_clips(armature, posed=posed)]
    doubts += said_of_shear(wrong)
    if made.most > 4:
        doubts.append(
            f"Segments of bendy bones are joints in '{path.name}', up to {made.most} for a splat (JOINTS_1); viewers "
            "that read four show such splats a little off."
        )
    splats = [obj for obj in objects if is_splat_object(obj)]
    lost = [(obj, armature_of(obj)) for obj in splats]
    doubts += [s for obj, rig in lost if animations and rig is not None for s in moved_without_joints(obj, rig)]
    return doubts + [s for obj, rig in lost for s in lost_in_gltf(obj, segments=rig is None or can_be_joints(rig))]


def _export(
    path: Path, deform_bones_only: bool, animations: bool, most: int, options: dict[str, Any]
) -> None:
    """Run Blender's exporter; most: how many joints a splat may have."""
    _failures.clear()
    bpy.ops.export_scene.gltf(
        filepath=str(path),
        check_existing=False,
        export_format="GLB",
        use_selection=True,
        export_apply=False,
        export_yup=True,
        use_mesh_vertices=True,
        export_skins=True,
        export_all_influences=False,
        export_influence_nb=max(4, most + -most % 4),  # whole sets: it counts the last one's empty places
        export_def_bones=deform_bones_only,
        export_morph=False,
        export_animations=animations,
        export_anim_slide_to_zero=True,
        export_materials="EXPORT",
        **options,
    )
    if _failures:
        raise _failures[0]


def _seen(objects: Sequence[bpy.types.Object]) -> Sequence[bpy.types.Object]:
    """Those of the objects that are not hidden: what an artist hides is not to be exported."""
    layer = bpy.context.view_layer
    layer.update()
    return [obj for obj in objects if layer.objects.get(obj.name) == obj and obj.visible_get(view_layer=layer)]


def _moves_splats(obj: Any) -> bool:
    return obj is not None and obj.type == "ARMATURE" and any(
        is_splat_object(other) and armature_of(other) == obj for other in bpy.data.objects
    )


def _last_error(error: RuntimeError) -> str:
    """The line of an operator's traceback that says what happened."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    named = [line for line in lines if "Error: " in line and not line.startswith("Error: Python")]
    return named[-1] if named else lines[-1] if lines else "no reason given"


@contextmanager
def _by_ourselves(path: Path) -> Iterator[None]:
    """The export is one of `export_glb`, not of Blender's own dialog."""
    _ours.append(path)
    try:
        yield
    finally:
        _ours.pop()


@contextmanager
def _selected(objects: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Exactly these objects are selected inside the block."""
    layer = bpy.context.view_layer
    layer.update()  # objects linked just now are not among its objects before
    # Looked up in a set: asking Blender's collection, or a list, for each object is quadratic.
    present = set(layer.objects)
    before, active = {obj for obj in present if obj.select_get()}, layer.objects.active
    try:
        for obj in before:
            obj.select_set(False)
        for obj in objects:
            if obj in present:
                obj.select_set(True)
            if obj not in present or not obj.select_get():
                raise InputError(f"'{obj.name}' is hidden or not in the scene; show it and export again.")
        yield
    finally:
        for obj in layer.objects:
            obj.select_set(obj in before)
        layer.objects.active = active


@contextmanager
def _discoverable() -> Iterator[None]:
    """The exporter finds `SplatExport` inside the block even where gskin is not an enabled add-on.

    It asks the modules of enabled add-ons, its own among them.
    """
    addons = bpy.context.preferences.addons.keys()
    if _EXPORTER not in addons:
        raise GSkinError(
            "Blender's glTF exporter is switched off; enable 'glTF 2.0 format' in the preferences."
        )
    package = (__package__ or "").rpartition(".")[0]
    if package in addons:
        yield
        return
    module = sys.modules[_EXPORTER]
    before = getattr(module, "glTF2ExportUserExtensions", None)
    module.glTF2ExportUserExtensions = [*(before or []), SplatExport]  # type: ignore[attr-defined]
    try:
        yield
    finally:
        if before is None:
            del module.glTF2ExportUserExtensions
        else:
            module.glTF2ExportUserExtensions = before  # type: ignore[attr-defined]


def _add_splats(gltf2_mesh: Any, cloud: SplatCloud) -> None:
    """Give the mesh's one primitive the attributes, the extension object and the note on skinning."""
    from io_scene_gltf2.io.com.gltf2_io_extensions import Extension

    primitive = gltf2_mesh.primitives[0]
    count = primitive.attributes["POSITION"].count
    if len(gltf2_mesh.primitives) != 1 or count != cloud.count:
        raise InputError(f"'{gltf2_mesh.name}' has faces or edges besides its splats; delete them first.")
    # What else the exporter found (vertex colours, upper-cased names) is not in glTF's axes or not legal.
    kept = ("POSITION", "JOINTS_", "WEIGHTS_", "_")
    attributes = {name: value for name, value in primitive.attributes.items() if name.startswith(kept)}
    attributes["COLOR_0"] = _accessor(gltf.fallback_color(cloud))
    for name, values in gltf.encode_attributes(cloud).items():
        attributes[name] = _accessor(values)
    primitive.attributes = attributes
    # Points without normals are drawn unlit; the splats' Blender material means nothing outside.
    primitive.material = None
    primitive.extensions = dict(primitive.extensions or {})
    primitive.extensions[gltf.EXTENSION_NAME] = Extension(
        name=gltf.EXTENSION_NAME, extension=dict(gltf.EXTENSION), required=False
    )
    if cloud.offset.any():
        primitive.extras = {**(primitive.extras or {}), gltf.OFFSET_EXTRAS_NAME: cloud.offset.tolist()}
    if "JOINTS_0" in attributes:
        primitive.extras = {**(primitive.extras or {}), gltf.SKINNING_EXTRAS_NAME: dict(gltf.SKINNING_EXTRAS)}


def _make_roots(scene: Any) -> None:
    """Move the nodes of skinned splats to the top of the scene, without a transform, which skins ignore."""
    waiting, splats = [(None, node) for node in scene.nodes], []
    parents: dict[int, Any] = {}
    while waiting:
        parent, node = waiting.pop()
        parents[id(node)] = parent
        waiting += [(node, child) for child in node.children or ()]
        if node.skin is not None and node.mesh is not None and _is_splat_mesh(node.mesh):
            splats.append((parent, node))
    for parent, node in splats:
        carriers = {id(parents[id(joint)]): parents[id(joint)] for joint in node.skin.joints if id(joint) in parents}
        tops = [carrier for carrier in carriers.values() if carrier not in node.skin.joints]
        if node.skin.skeleton is None and len(tops) == 1 and tops[0] is not None:
            node.skin.skeleton = tops[0]
        node.translation = node.rotation = node.scale = node.matrix = None
        if parent is not None:
            parent.children = [child for child in parent.children if child is not node]
            scene.nodes.append(node)


def _is_splat_mesh(mesh: Any) -> bool:
    return any(gltf.EXTENSION_NAME in (primitive.extensions or {}) for primitive in mesh.primitives)


def _accessor(values: NDArray[Any]) -> Any:
    """An accessor of the exporter for an array (N,) or (N, k) of float32, or of normalised uint16."""
    from io_scene_gltf2.io.com import gltf2_io
    from io_scene_gltf2.io.com.constants import BufferViewTarget, ComponentType, DataType
    from io_scene_gltf2.io.exp.binary_data import BinaryData

    width = 1 if values.ndim == 1 else values.shape[1]
    is_float = values.dtype == np.float32
    return gltf2_io.Accessor(
        buffer_view=BinaryData(values.tobytes(), BufferViewTarget.ARRAY_BUFFER),
        byte_offset=None,
        component_type=ComponentType.Float if is_float else ComponentType.UnsignedShort,
        count=len(values),
        extensions=None,
        extras=None,
        max=None,
        min=None,
        name=None,
        normalized=None if is_float else True,
        sparse=None,
        type={1: DataType.Scalar, 3: DataType.Vec3, 4: DataType.Vec4}[width],
    )
