# SPDX-License-Identifier: GPL-3.0-or-later
"""Where and how the scene's Output settings want a picture, and Blender's own writer for formats that are not ours."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files import replaced
from ..core.render.output import Output
from ..core.render.picture import to_linear, to_srgb

_OWN = {"PNG": "png", "OPEN_EXR": "exr", "OPEN_EXR_MULTILAYER": "exr"}
_MOVIES = {"FFMPEG", "AVI_JPEG", "AVI_RAW"}


def frame_output(scene: bpy.types.Scene, frame: int, *, depth: bool, path: Path | None = None) -> Output:
    """The file of a frame, or `path`. depth: also in an EXR's channel Z, or for other formats in an .exr beside it.

    Raises InputError for a movie format.
    """
    render = scene.render
    settings: Any = render.image_settings
    form = settings.file_format
    if form in _MOVIES:
        raise InputError(
            "Splats are rendered to images, and the output format is a movie; choose PNG or OpenEXR in the Output "
            "properties and join the images later."
        )
    if path is None:
        path = Path(bpy.path.abspath(render.frame_path(frame=frame)))
    ours = _OWN.get(form, "raw")
    beside = path if ours == "exr" else path.with_name(f"{path.stem}_depth.exr")
    return Output(
        path=str(path),
        form=ours,
        bits=int(settings.color_depth) if ours != "raw" else 32,
        alpha=settings.color_mode == "RGBA",
        transparent=render.film_transparent,
        background=background(scene),
        grey=settings.color_mode == "BW",
        depth=str(beside) if depth else "",
        compress=settings.compression if ours == "png" else int(settings.exr_codec != "NONE"),
        pixel_aspect=render.pixel_aspect_x / render.pixel_aspect_y,
    )


def background(scene: bpy.types.Scene) -> tuple[float, float, float]:
    """The world's plain colour in sRGB (3,); what is linked to it, as an image, does not count."""
    world: Any = scene.world
    if world is None:
        return (0.0, 0.0, 0.0)
    color = np.array(world.color, np.float32)
    # From Blender 5.0 a world always has nodes.
    if getattr(world, "use_nodes", True) and world.node_tree is not None:
        node = next((node for node in world.node_tree.nodes if node.type == "BACKGROUND"), None)
        if node is not None:
            value, strength = node.inputs["Color"].default_value, node.inputs["Strength"].default_value
            color = np.array(value[:3], np.float32) * strength
    red, green, blue = to_srgb(color).tolist()
    return red, green, blue


def write_with_blender(rgba: NDArray[np.float32], output: Output, scene: bpy.types.Scene) -> None:
    """Write (H, W, 4), straight sRGB, in the scene's format; Blender stands still meanwhile.

    Colours are as captured, whatever view transform the scene has. Raises GSkinError where it cannot be written.
    """
    height, width = rgba.shape[:2]
    image = bpy.data.images.new("GSkin Render", width, height, alpha=True, float_buffer=True)
    # A scene of its own: that of the artist keeps its view transform, and nothing is evaluated anew.
    own = bpy.data.scenes.new("GSkin Render")
    try:
        linear = np.concatenate([to_linear(rgba[..., :3]) * rgba[..., 3:], rgba[..., 3:]], axis=2)
        pixels: Any = image.pixels
        pixels.foreach_set(np.ascontiguousarray(linear[::-1], np.float32).ravel())
        _copy(scene.render.image_settings, own.render.image_settings)
        view: Any = own.view_settings
        view.view_transform = "Standard"
        path = Path(output.path)
        with replaced(path, path.suffix) as temporary:
            image.save_render(str(temporary), scene=own)
    finally:
        bpy.data.scenes.remove(own)
        bpy.data.images.remove(image)


def raw_output(output: Output, folder: Path) -> Output:
    """The same picture for `write_with_blender`, as a file in a folder of ours."""
    return replace(output, path=str(folder / "picture.npz"))


def _copy(source: Any, target: Any) -> None:
    """Format and quality of image settings, the kind of file first, because it decides on the rest."""
    names = [p.identifier for p in source.bl_rna.properties if not p.is_readonly and p.type != "POINTER"]
    for name in sorted(names, key=lambda name: (name != "media_type", name != "file_format")):
        with contextlib.suppress(AttributeError, TypeError):  # some do not apply to this format
            setattr(target, name, getattr(source, name))
