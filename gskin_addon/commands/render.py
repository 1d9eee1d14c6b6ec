# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin render`: a picture of splats, or of rigged splats in a pose."""

from __future__ import annotations

import argparse
import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import write_png
from ..core.job.settings import FRONTS
from ..core.splats.axes import rotate_cloud, up_rotation
from ..core.splats.cloud import SH_C0, SplatCloud
from .console import print_message
from .paths import check_output
from .pose import posed
from .rig import read_splats

if TYPE_CHECKING:
    import bpy

CAMERA = "camera"
"""The --view that stands for the scene's own camera."""


def run(options: argparse.Namespace) -> None:
    """Do it. Raises InputError for what cannot be used."""
    if options.view == CAMERA:
        from .render_camera import run_camera

        run_camera(options)
        return
    check_output(options.out, "--out", (".png",))
    if options.frames or options.resume or options.depth:
        raise InputError("--frames, --resume and --depth are for the scene's camera; add --view camera.")
    if options.source.suffix.lower() != ".blend":
        posing = options.rotate or options.set or options.action or options.frame is not None
        if options.engine == "cycles" or options.color != "splats" or posing:
            raise InputError(f"'{options.source}' has no rig to pose, colour or render by; give a rigged .blend.")
        cloud = read_splats(options.source, drop_invalid=True)
        draw(rotate_cloud(cloud, up_rotation(options.up or cloud.up or "z")), options)
    else:
        with posed(options) as obj:
            if options.engine == "cycles":
                from ..scene.cycles import render_view
                from ..scene.deform_stack import shown_wrongly

                for sentence in shown_wrongly(obj):
                    print_message(f"Warning: {sentence}")
                azimuth = options.view.replace("-", "_")
                render_view(obj, options.out, azimuth, options.size, options.background, front=FRONTS[options.front])
            else:
                from ..scene.posing import posed_cloud

                cloud = posed_cloud(obj)
                if options.color == "weights":
                    cloud = _colored(cloud, _weight_colors(obj))
                elif options.color == "confidence":
                    cloud = _colored(cloud, _confidence_colors(obj))
                draw(cloud, options)
    print_message(f"'{options.out}' is drawn.")


def draw(cloud: SplatCloud, options: argparse.Namespace) -> None:
    """Rasterise the cloud, framed on itself, and write the PNG."""
    from ..core.render.camera import EVALUATION_AZIMUTHS, orbit_views, percentile_bounds
    from ..core.render.rasterizer import has_to_compile, render_cloud

    lower, upper = percentile_bounds(cloud.means)
    azimuth = EVALUATION_AZIMUTHS[options.view.replace("-", "_")]
    (camera,) = orbit_views(lower, upper, options.size, [azimuth], front=FRONTS[options.front], margin=0.06)
    if has_to_compile():
        print_message("Compiling what draws, once: the first picture takes some seconds longer.")
    image, _ = render_cloud(cloud, camera, background=options.background)
    write_png(options.out, image)


def _colored(cloud: SplatCloud, rgb: NDArray[Any]) -> SplatCloud:
    return dataclasses.replace(cloud, sh=((rgb - 0.5) / SH_C0)[:, None, :].astype(np.float32))


def _confidence_colors(obj: bpy.types.Object) -> NDArray[Any]:
    from ..core.rig.colors import heat_colors
    from ..scene import names
    from ..scene.attributes import read_attribute

    confidence = read_attribute(obj.data, names.CONFIDENCE)
    if confidence is None:
        raise InputError(f"'{obj.name}' does not know how sure its weights are; skin it again with `gskin rig`.")
    return heat_colors(1.0 - confidence)


def _weight_colors(obj: bpy.types.Object) -> NDArray[Any]:
    from ..core.rig.colors import weight_colors
    from ..scene.weights import read_weights

    weights, _ = read_weights(obj)
    total = weights.sum(axis=1, keepdims=True)
    return weight_colors(weights / np.maximum(total, 1e-12))
