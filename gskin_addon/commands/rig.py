# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin rig`: splats and an armature in, rigged splats out."""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.guidance.options import PROVIDER_OPTIONS, check_models, with_absolute_folders
from ..core.job.contract import Result, write_job, write_weights
from ..core.job.mesh_files import read_mesh, write_mesh
from ..core.job.progress import ProgressEvent
from ..core.job.progress_text import ProgressPrinter
from ..core.job.settings import JobSettings
from ..core.rig.lbs import sparsify
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.cleanup import clamp_aspect, find_faint_giants, find_strays, isotropic
from ..core.splats.cloud import SplatCloud
from ..core.splats.ply import read_ply
from ..core.worker.client import WorkerClient
from ..core.worker.interpreter import find_worker_python
from .blender import require_bpy
from .console import say
from .paths import check_output, same_file

if TYPE_CHECKING:
    import bpy
    from numpy.typing import NDArray

    Array = NDArray[Any]


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used, WorkerError where the job failed, Cancelled."""
    check_output(options.out, "--out", (".blend", ".glb"))
    of_guidance = guidance_options(options)
    if options.weights is not None:
        check_output(options.weights, "--weights", (".npz",))
    for given in (options.armature, options.splats, *([options.mesh] if options.mesh else [])):
        if same_file(given, options.out):
            raise InputError(f"--out '{options.out}' would overwrite its own input; choose another name.")
    python = find_worker_python(options.python)
    if python is None:
        raise InputError(
            "No Python with torch was found for the worker; name one with --python or GSKIN_PYTHON "
            "(pip install 'gskin_addon[worker]' makes one)."
        )
    cloud = read_splats(options.splats, options.ply_up, options.drop_invalid)
    cloud = clean(cloud, options.drop_strays, options.max_aspect, options.isotropic)
    mesh = None if options.mesh is None else read_proxy(options.mesh, options.mesh_up)

    require_bpy()
    from ..scene import rig_files
    from ..scene.armature import read_skeleton

    rig_files.empty_scene()
    armature = rig_files.import_armature(options.armature, options.armature_name)
    skeleton = read_skeleton(armature)
    settings = {
        "preset": options.preset,
        "init": options.init,
        "guidance": options.guidance,
        "field": options.field,
        "rasterizer": options.rasterizer,
        "max_influences": options.max_influences,
        "seed": options.seed,
        "front": options.front,
        "init_options": {"model": str(options.init_model.absolute())} if options.init_model else {},
        "options": of_guidance,
    }
    JobSettings.parse(settings)
    printer = ProgressPrinter(options.progress)
    with _job_folder(options.job_dir) as folder, contextlib.closing(printer):
        if mesh is not None:
            settings["mesh"] = write_mesh(folder, *mesh)
        write_job(
            folder,
            cloud,
            skeleton,
            settings,
            splats=f"'{options.splats}'",
            armature=f"Armature '{armature.name}'",
            up=options.ply_up,
        )
        result = _work(python, folder, printer)
        weights = sparsify(result.weights, options.max_influences)
        printer(ProgressEvent("save", 1.0, message=options.out.name))
        if options.weights is not None:
            write_weights(options.weights, weights, skeleton, result.mesh_weights, result.confidence)
        obj = _bind(cloud, options.splats.stem, armature, weights, result, options.max_influences)
        # glTF knows no anchors: there the splats keep weights of their own, blended from the mesh's.
        if mesh is not None and options.out.suffix.lower() == ".blend":
            _anchor(obj, options.mesh.stem, mesh, armature, result)
        _save(options.out, obj)
    say(f"{cloud.count:,} splats follow {skeleton.count} bones in '{options.out}'.")


def read_splats(path: Path, up: str, drop_invalid: bool) -> SplatCloud:
    """The splats of a .ply in Blender's world axes; says how many were dropped."""
    if path.suffix.lower() != ".ply":
        raise InputError(f"'{path}' is no .ply file; export the splats as a Gaussian splat .ply.")
    if not path.is_file():
        raise InputError(f"'{path}' does not exist; check the path of the splats.")
    splats = read_ply(path, drop_invalid=drop_invalid)
    dropped = splats.total - splats.cloud.count
    if dropped:
        say(f"'{path}': {dropped:,} invalid splats of {splats.total:,} were left out.")
    return splats.cloud if up == "z" else rotate_cloud(splats.cloud, up_rotation(up))


def read_proxy(path: Path, up: str | None) -> tuple[Any, Any]:
    """Vertices in Blender's world axes and triangles of a mesh file; glTF's y axis points up by its own rules."""
    verts, faces = read_mesh(path)
    up = up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    return verts @ up_rotation(up).T, faces


def clean(cloud: SplatCloud, drop_strays: bool, max_aspect: float, balls: bool) -> SplatCloud:
    """The splats without what deforms badly; says how many were changed."""
    if drop_strays:
        strays, giants = find_strays(cloud), find_faint_giants(cloud)
        say(f"{strays.sum():,} strays and {giants.sum():,} faint giants of {cloud.count:,} splats were left out.")
        cloud = cloud.select(~(strays | giants))
    if max_aspect:
        cloud, needles = clamp_aspect(cloud, max_aspect)
        say(f"{needles.sum():,} needles of {cloud.count:,} splats were widened.")
    return isotropic(cloud) if balls else cloud


def parse_options(given: list[str], option: str = "--guidance-option") -> dict[str, Any]:
    """NAME=VALUE pairs as settings; a value that is JSON (a number, true) is taken as such, else as text."""
    values: dict[str, Any] = {}
    for pair in given:
        name, equals, text = pair.partition("=")
        if not name or not equals:
            raise InputError(f"{option} '{pair}' is not NAME=VALUE.")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text
    return values


def guidance_options(options: argparse.Namespace) -> dict[str, Any]:
    """The guidance's settings, of the types that it wants. Raises InputError for those it does not know."""
    values = parse_options(options.guidance_option)
    kinds = PROVIDER_OPTIONS.get(options.guidance)
    if kinds is None:
        if options.allow_download:
            raise InputError(f"--allow-download is of no use: the guidance '{options.guidance}' fetches nothing.")
        return values
    texts = {pair.partition("=")[0]: pair.partition("=")[2] for pair in options.guidance_option}
    for name, text in texts.items():
        if isinstance(getattr(kinds(), name, None), str):
            values[name] = text  # a folder called 7 is still a name
    if options.allow_download:
        values["allow_download"] = True
    check_models(options.guidance, values)
    return with_absolute_folders(options.guidance, values)


def _work(python: Path, folder: Path, printer: ProgressPrinter) -> Result:
    client = WorkerClient(python, folder)
    client.start()
    return client.wait(printer)


def _bind(
    cloud: SplatCloud, name: str, armature: bpy.types.Object, weights: Array, result: Result, influences: int
) -> bpy.types.Object:
    from ..scene.splat_object import create_splat_object
    from ..scene.weights import write_weights as write_groups

    obj = create_splat_object(cloud, name)
    write_groups(
        obj, armature, weights, result.bones, max_influences=influences, confidence=result.confidence
    )
    return obj


def _anchor(
    obj: bpy.types.Object, name: str, mesh: tuple[Array, Array], armature: bpy.types.Object, result: Result
) -> None:
    from ..scene.anchored import anchor_to_mesh
    from ..scene.proxy_object import create_proxy

    anchor_to_mesh(obj, create_proxy(name, *mesh, armature, result.mesh_weights, result.bones))


def _save(out: Path, obj: bpy.types.Object) -> None:
    from ..scene import rig_files

    if out.suffix.lower() == ".glb":
        from ..scene.gltf_export import export_glb

        export_glb(out, [obj])
    else:
        rig_files.save_blend(out)


@contextlib.contextmanager
def _job_folder(kept: Path | None) -> Iterator[Path]:
    """The folder given, which stays, or one for this run only."""
    if kept is not None:
        yield kept
        return
    with tempfile.TemporaryDirectory(prefix="gskin-job-") as folder:
        yield Path(folder)
