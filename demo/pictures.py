# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo's pictures: contact sheet, weights in bone colours, and a turning animation."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gskin_addon.core.render.camera import Camera, orbit_views, percentile_bounds
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.colors import weight_colors
from gskin_addon.core.rig.lbs import skin_cloud
from gskin_addon.core.splats.cloud import SH_C0, SplatCloud

Array = NDArray[np.floating]
# A standing figure fills little of the box that holds its every turn.
ZOOM = 1.2
PAPER, INK = (0.965, 0.955, 0.935), (52, 47, 58)


def contact_sheet(
    cloud: SplatCloud,
    poses: dict[str, Array],
    weights: dict[str, Array],
    azimuths: Sequence[float],
    cell: int,
) -> Image.Image:
    """A row per pose: splats at rest, then posed with each of `weights`; poses are transforms (B, 4, 4)."""
    rows = []
    for transforms, azimuth in zip(poses.values(), azimuths, strict=True):
        camera = _camera(cloud, azimuth, cell, margin=0.03)
        moved = [skin_cloud(cloud, each, transforms) for each in weights.values()]
        rows.append([_picture(each, camera) for each in (cloud, *moved)])
    return _grid(rows, ["rest", *weights], list(poses))


def weight_sheet(cloud: SplatCloud, weights: dict[str, Array], cell: int) -> Image.Image:
    """Front and back of the splats in their own colours, and coloured by bone with each of `weights`."""
    painted = [
        replace(cloud, sh=((weight_colors(each) - 0.5) / SH_C0)[:, None].astype(np.float32))
        for each in weights.values()
    ]
    rows = [
        [_picture(each, _camera(cloud, azimuth, cell, margin=0.01)) for each in (cloud, *painted)]
        for azimuth in (25.0, 205.0)
    ]
    return _grid(rows, ["splats", *weights], ["front", "back"])


def animation(
    cloud: SplatCloud, weights: Array, transforms_at: Callable[[float], Array], frames: int, size: int
) -> list[Image.Image]:
    """The action played twice during one turn around the splats."""
    pictures = []
    for frame in range(frames):
        phase = frame / frames
        camera = _camera(cloud, 30.0 + 360.0 * phase, size, margin=0.02)
        pictures.append(_to_image(_picture(skin_cloud(cloud, weights, transforms_at(2 * phase % 1.0)), camera)))
    return pictures


def save_gif(pictures: Sequence[Image.Image], path: Path, seconds: float) -> None:
    """A looping GIF with one palette for all frames."""
    strip = Image.new("RGB", (pictures[0].width * 4, pictures[0].height))
    for i in range(4):
        strip.paste(pictures[i * len(pictures) // 4], (i * pictures[0].width, 0))
    palette = strip.quantize(128, method=Image.Quantize.MEDIANCUT)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    temporary = path.with_name(f".{path.name}.tmp")
    duration = round(1000 * seconds / len(frames))
    frames[0].save(
        temporary,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=duration,
        loop=0,
        optimize=True,
    )
    os.replace(temporary, path)


def save_png(picture: Image.Image, path: Path) -> None:
    """A PNG that is there whole or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    picture.save(temporary, format="PNG", optimize=True)
    os.replace(temporary, path)


def _camera(cloud: SplatCloud, azimuth: float, size: int, margin: float) -> Camera:
    lower, upper = percentile_bounds(cloud.means, 0.0)
    # Framed on a box that is as deep as the figure is wide, so that turning changes nothing.
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    half[:2] = half[:2].max()
    (camera,) = orbit_views(middle - half, middle + half, size, [azimuth], elevation=6.0, margin=margin)
    return replace(camera, fx=ZOOM * camera.fx, fy=ZOOM * camera.fy)


def _picture(cloud: SplatCloud, camera: Camera) -> Array:
    # Drawn at twice the size and averaged, which smooths the edges of the splats.
    big = camera.resized(2 * camera.width)
    image = render_cloud(cloud, big, background=PAPER)[0]
    height, width, _ = image.shape
    return image.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))


def _to_image(picture: Array) -> Image.Image:
    return Image.fromarray(np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8))


def _grid(rows: list[list[Array]], columns: list[str], names: list[str]) -> Image.Image:
    cell = rows[0][0].shape[0]
    head, side = 44, 44
    paper = tuple(round(255 * channel) for channel in PAPER)
    sheet = Image.new("RGB", (side + cell * len(columns), head + cell * len(rows)), paper)
    font = ImageFont.load_default(size=22)
    draw = ImageDraw.Draw(sheet)
    for c, label in enumerate(columns):
        draw.text((side + cell * (c + 0.5), head / 2), label, INK, font=font, anchor="mm")
    for r, label in enumerate(names):
        strip = Image.new("RGB", (cell, side), paper)
        ImageDraw.Draw(strip).text((cell / 2, side / 2), label, INK, font=font, anchor="mm")
        sheet.paste(strip.rotate(90, expand=True), (0, head + cell * r))
        for c, picture in enumerate(rows[r]):
            sheet.paste(_to_image(picture), (side + cell * c, head + cell * r))
    return sheet
