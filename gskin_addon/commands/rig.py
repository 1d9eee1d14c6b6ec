# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin rig`: splats and an armature in, rigged splats out."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.files import replaced
from ..core.guidance import BENCHMARK_ONLY
from ..core.guidance.options import PROVIDER_OPTIONS, check_models, with_absolute_folders
from ..core.job.contract import WEIGHTS
from ..core.job.mesh_files import read_mesh
from ..core.job.progress import ProgressEvent
from ..core.job.progress_text import ProgressPrinter
from ..core.job.settings import JobSettings
from ..core.job.up_axis import AUTO, default_up, resolve_up
from ..core.pipeline.estimate import warning_of_time
from ..core.splats import formats
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.cleanup import clamp_aspect, find_faint_giants, find_strays, isotropic
from ..core.splats.cloud import SplatCloud
from ..core.worker.own_python import job_python
from .blender import require_bpy
from .console import print_message
from .job_settings import job_settings, parse_options, warning_of_no_guidance
from .paths import check_output, same_file
from .rig_scale import fit_rig_scale
from .selection import read_walls

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


_WALLS = "gskin walls"
"""Column of the walls' labels while splats are sorted out."""


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used, WorkerError where the job failed, Cancelled."""
    check_output(options.out, "--out", (".blend", ".glb"))
    of_guidance = guidance_options(options)
    if options.weights is not None:
        check_output(options.weights, "--weights", (".npz",))
    for given in (options.armature, options.splats, options.mesh):
        if given is not None and same_file(given, options.out):
            raise InputError(f"--out '{options.out}' would overwrite its own input; choose another name.")
    cloud = read_splats(options.splats, options.drop_invalid, options.walls)
    cloud = clean(cloud, options.drop_strays, options.max_aspect, options.isotropic)
    cloud, walls = _without_walls(cloud)
    mesh = None if options.mesh is None else read_proxy(options.mesh, options.mesh_up)

    settings = job_settings(options, of_guidance)
    chosen = JobSettings.parse(settings)
    needs_runtime = chosen.needs_runtime or options.mesh is not None
    python = job_python(needs_runtime, options.python or "")

    require_bpy()
    from ..scene import names, rig_files
    from ..scene.armature import read_skeleton
    from ..scene.dependencies import needed_objects, unheard_drivers
    from ..scene.placement import bring_rig, fits_in_file
    from ..scene.proxy_object import create_mesh_object
    from ..scene.seams import write_seams
    from ..scene.splat_object import create_splat_object
    from ..session.skin_job import SkinJob
    from .save import save_rigged

    rig_files.empty_scene()
    doubts: list[str] = []
    if options.fit is not None:
        from .fit import fit_kind, make_rig

        up, assumed = resolve_up(options.up or AUTO, cloud, None, options.splats)
        found = fit_kind(options.fit, rotate_cloud(cloud, up_rotation(up)), options)
        armature = make_rig(found, options.splats.stem, rigify=options.rigify)
    else:
        armature = rig_files.import_armature(options.armature, options.armature_name, doubts)
    for sentence in doubts:
        print_message(f"Warning: {sentence}")
    for path in unheard_drivers(needed_objects(armature)):
        print_message(f"The driver of {path} needs Python, which no file may run here; its value stays as it is.")
    skeleton = read_skeleton(armature)
    if options.fit is not None:
        pass  # the skeleton was fitted to the splats as they stand
    elif options.up is None:
        up, assumed = default_up(cloud, skeleton, options.splats)
    else:
        up, assumed = resolve_up(options.up, cloud, skeleton, options.splats)
    if assumed:
        print_message(f"'{options.splats}': {assumed}.")
    turned = rotate_cloud(cloud, up_rotation(up))
    splats = create_splat_object(turned, options.splats.stem)
    splats.data[names.MARK]["up"] = up
    write_seams(splats, walls)
    if fits_in_file(turned, read_skeleton(armature)):
        bring_rig(armature, -turned.offset)
        print_message(f"Armature '{armature.name}' stands where the file has the splats, and was moved with them.")
    fit_rig_scale(splats, armature, options.rig_scale)
    proxy = None if mesh is None else create_mesh_object(options.mesh.stem, *mesh)
    for warning in (warning_of_time(chosen, turned.count, skeleton.count), warning_of_no_guidance(options, chosen)):
        if warning:
            print_message(warning)
    # glTF knows no anchors, there the splats keep weights of their own, blended from the mesh's; and no fabric.
    blend = options.out.suffix.lower() == ".blend"
    with _job_folder(options.job_dir) as folder, contextlib.closing(ProgressPrinter(options.progress)) as printer:
        job = SkinJob.start(
            splats,
            armature,
            settings,
            python,
            proxy,
            anchored=blend,
            folder=folder,
            label=f"'{options.splats}'",
            allow_download=options.allow_download,
            paintable=blend and options.paintable,
        )
        job.wait(printer)
        printer(ProgressEvent("save", 1.0, message=options.out.name))
        if options.weights is not None:
            with replaced(options.weights) as temporary:
                shutil.copyfile(job.client.folder / WEIGHTS, temporary)
        sentence = job.apply()
        save_rigged(options.out, splats)
    axis = "" if assumed or options.up else f", {up.upper()} up"
    print_message(f"{sentence}{axis}, in '{options.out}'.")


def read_splats(path: Path, drop_invalid: bool, walls: Sequence[Path] = ()) -> SplatCloud:
    """The splats of a file with its own axes; says how many were dropped.

    walls: files of marked splats, by their rows in the file, see `read_walls`; their labels are an extra column.
    """
    if formats.find_format(path) is formats.FORMATS["sog"]:
        _find_webp_decoder()
    splats = formats.read_splats(path, drop_invalid=drop_invalid)
    dropped = splats.total - splats.cloud.count
    if dropped:
        print_message(f"'{path}': {dropped:,} invalid splats of {splats.total:,} were left out.")
    for note in splats.cloud.notes:
        print_message(f"'{path}': {note}.")
    if walls:
        labels = read_walls(walls, splats.total)[splats.kept]
        return replace(splats.cloud, extra={**splats.cloud.extra, _WALLS: labels})
    return splats.cloud


def _without_walls(cloud: SplatCloud) -> tuple[SplatCloud, Array | None]:
    """The cloud without the column of walls, and the column."""
    rest = {name: values for name, values in cloud.extra.items() if name != _WALLS}
    return replace(cloud, extra=rest), cloud.extra.get(_WALLS)


def _find_webp_decoder() -> None:
    """Without Pillow, Blender decodes the images of a .sog."""
    if importlib.util.find_spec("PIL") is None and importlib.util.find_spec("bpy") is not None:
        from ..scene.webp_images import register

        register()


def read_proxy(path: Path, up: str | None) -> tuple[Any, Any]:
    """Vertices in Blender's world axes and triangles of a mesh file; glTF's y axis points up by its own rules."""
    verts, faces = read_mesh(path)
    up = up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    return verts @ up_rotation(up).T, faces


def clean(cloud: SplatCloud, drop_strays: bool, max_aspect: float, balls: bool) -> SplatCloud:
    """The splats without what deforms badly; says how many were changed."""
    if drop_strays:
        strays, giants = find_strays(cloud), find_faint_giants(cloud)
        counts = f"{strays.sum():,} strays and {giants.sum():,} faint giants of {cloud.count:,} splats"
        print_message(f"{counts} were left out.")
        cloud = cloud.select(~(strays | giants))
    if max_aspect:
        cloud, needles = clamp_aspect(cloud, max_aspect)
        print_message(f"{needles.sum():,} needles of {cloud.count:,} splats were widened.")
    return isotropic(cloud) if balls else cloud


def guidance_options(options: argparse.Namespace) -> dict[str, Any]:
    """The guidance's settings, of the types that it wants. Raises InputError for those it does not know."""
    values = parse_options(options.guidance_option)
    kinds = PROVIDER_OPTIONS.get(options.guidance)
    if kinds is None:
        if options.allow_download:
            raise InputError(f"--allow-download is of no use: the guidance '{options.guidance}' fetches nothing.")
        if values and options.guidance not in BENCHMARK_ONLY:
            raise InputError(
                f"The guidance '{options.guidance}' has no option '{next(iter(values))}', nor any other; leave it out, "
                f"or choose the --guidance that it is for ({', '.join(PROVIDER_OPTIONS)})."
            )
        return values
    texts = {pair.partition("=")[0]: pair.partition("=")[2] for pair in options.guidance_option}
    for name, text in texts.items():
        if isinstance(getattr(kinds(), name, None), str):
            values[name] = text  # a folder called 7 is still a name
    check_models(options.guidance, values)
    return with_absolute_folders(options.guidance, values)


@contextlib.contextmanager
def _job_folder(kept: Path | None) -> Iterator[Path]:
    """The folder given, which stays, or one for this run only."""
    if kept is not None:
        yield kept
        return
    with tempfile.TemporaryDirectory(prefix="gskin-job-") as folder:
        yield Path(folder)
