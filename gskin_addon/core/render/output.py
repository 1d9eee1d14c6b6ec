# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of *Render Splats* as files: PNG with straight alpha in sRGB, OpenEXR with linear colours and depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files import write_arrays, write_png
from .exr import write_exr
from .picture import Picture, to_linear

Array = NDArray[np.float32]

NO_DEPTH = 1e10
"""Depth where there is nothing, as in Blender's own depth pass."""


@dataclass(frozen=True)
class Output:
    """Where and how a frame is written.

    path: the file. form: "png", "exr", or "raw" (an .npz with `rgba` (H,W,4), straight sRGB, for another writer).
    bits: 8 or 16 for PNG, 16 or 32 for EXR. alpha: whether the file has it. transparent: nothing lies behind the
    splats; else `background` (3,), sRGB, does where no other object stands. grey: one brightness for each pixel.
    depth: a further .exr for the depth; "" for none, the path itself for a channel Z of the same file.
    compress: 0 to 100, of PNG; of EXR 0 or more. pixel_aspect: width of a pixel by its height.
    """

    path: str
    form: str
    bits: int = 8
    alpha: bool = True
    transparent: bool = True
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grey: bool = False
    depth: str = ""
    compress: int = 15
    pixel_aspect: float = 1.0


def write_picture(picture: Picture, hidden: NDArray[np.bool_], output: Output) -> None:
    """Write the picture, with holes where other objects hide it (H, W), and its depth.

    Raises:
        GSkinError: the disk is full or the folder cannot be written.
    """
    color, alpha = picture.color, picture.alpha
    if not output.transparent:
        gap = np.where(hidden, np.float32(0.0), 1.0 - alpha)
        color = color + gap[..., None] * np.asarray(output.background, np.float32)
        alpha = alpha + gap
    straight = color / np.maximum(alpha, np.float32(1e-6))[..., None]
    if output.grey:
        straight = np.repeat((straight @ np.array([0.2126, 0.7152, 0.0722], np.float32))[..., None], 3, axis=2)
    path = Path(output.path)
    depth = np.where(np.isfinite(picture.depth), picture.depth, np.float32(NO_DEPTH)).astype(np.float32)
    if output.form == "exr":
        kind = np.float16 if output.bits == 16 else np.float32
        linear = to_linear(straight) * alpha[..., None]
        planes: dict[str, NDArray[Any]] = {name: linear[..., k].astype(kind) for k, name in enumerate("RGB")}
        if output.alpha:
            planes["A"] = alpha.astype(kind)
        if output.depth == output.path:
            planes["Z"] = depth
        write_exr(path, planes, compress=output.compress > 0, pixel_aspect=output.pixel_aspect)
    else:
        if not output.alpha:
            straight = straight * alpha[..., None]  # over black, as Blender saves transparent film without alpha
        rgba = np.concatenate([straight, alpha[..., None]], axis=2)
        if output.form == "raw":
            write_arrays(path, {"rgba": rgba})
        else:
            level = 1 + round(0.08 * output.compress)
            write_png(path, rgba if output.alpha else rgba[..., :3], bits=output.bits, level=level)
    if output.depth and output.depth != output.path:
        # Y is what OpenEXR calls a picture in grey; a lone Z Blender shows as nothing.
        write_exr(Path(output.depth), {"Y": depth}, pixel_aspect=output.pixel_aspect)
