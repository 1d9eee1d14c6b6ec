# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin render --view camera`: what *Render Splats* does in a window, from the camera of a .blend's scene."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from ..core.errors import InputError
from ..core.job.progress_text import ProgressPrinter
from ..core.worker.interpreter import find_worker_python
from ..core.worker.own_python import job_python
from .console import print_message
from .paths import check_output


def run_camera(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    check_output(options.out, "--out", (".png", ".exr"))
    if options.source.suffix.lower() != ".blend":
        raise InputError(f"'{options.source}' has no scene with a camera; give a .blend, or another --view.")
    if options.engine == "cycles" or options.color != "splats":
        raise InputError("--view camera draws splats in their own colours; leave out --engine and --color.")
    frames = parse_frames(options.frames)
    from .pose import posed

    with posed(options):
        _render(options, frames)


def _render(options: argparse.Namespace, frames: list[int]) -> None:
    import bpy

    from ..session.render_job import RenderJob

    scene = bpy.context.scene
    settings = scene.render.image_settings
    settings.file_format = "PNG" if options.out.suffix.lower() == ".png" else "OPEN_EXR"
    settings.color_mode, scene.render.film_transparent = "RGBA", True
    scene.render.use_overwrite = not options.resume
    if frames:
        scene.render.filepath = str(options.out.absolute().with_suffix(""))
        scene.render.use_file_extension = True
    python = find_worker_python(options.python) or job_python(False)
    job = RenderJob.start(
        scene, bpy.context.view_layer, python, animation=bool(frames), hold_out=True, depth=options.depth,
        frames=frames or None, out=None if frames else Path(options.out).absolute(),
    )  # fmt: skip
    try:
        with contextlib.closing(ProgressPrinter(options.progress)) as printer:
            job.wait(printer)
    finally:
        sentence = job.close()
    print_message(sentence + ".")


def parse_frames(text: str | None) -> list[int]:
    """Frame numbers of "5", "1-24" or "1-24x2"; none where there is no text. InputError for anything else."""
    if not text:
        return []
    span, _, step = text.partition("x")
    first, _, last = span.partition("-")
    try:
        frames = list(range(int(first), int(last or first) + 1, int(step or 1)))
    except ValueError:
        frames = []
    if not frames:
        raise InputError(f"--frames {text} names no frames; write 5, 1-24 or 1-24x2.")
    return frames
