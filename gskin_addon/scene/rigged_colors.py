# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of meshes as the arrays that training reads: of triangle corners, and textures with their coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.training.textures import sample_image, to_linear, to_srgb
from .material_colors import MaterialColor, image_pixels, material_color

Array = NDArray[Any]

LARGEST_TEXTURE = 1024


@dataclass
class PartColors:
    """Colours of one mesh of F triangles: material (F,) index into `materials`; for each material its texture
    coordinates (F, 3, 2), and the colour attribute (F, 3, 3), linear, that it is multiplied by, or None."""

    material: Array
    materials: list[MaterialColor]
    uv: list[Array]
    tints: list[Array | None]


def read_colors(obj: bpy.types.Object, mesh: Any, faces: Array, loops: Array, material: Array) -> PartColors:
    """The colours of `obj`, whose evaluated mesh has triangles of vertices and of corners `faces`, `loops` (F, 3)."""
    slots = [material_color(slot.material) for slot in obj.material_slots] or [material_color(None)]
    return PartColors(
        np.clip(material, 0, len(slots) - 1),
        slots,
        [_uv(mesh, slot.uv, loops) for slot in slots],
        [_tint(mesh, slot.layer, faces, loops) for slot in slots],
    )


def color_arrays(parts: list[PartColors], notes: list[str]) -> dict[str, Array]:
    """The arrays of `core/training/textures.py` for all triangles of the parts, one after the other, and corner_rgb,
    which all readers know; `notes` hears of pictures that are missing."""
    images: list[Array] = []
    place: dict[tuple[str, bytes], int] = {}
    known: dict[str, Array | None] = {}
    linear, uvs, chosen, tints = [], [], [], []
    for part in parts:
        faces = len(part.material)
        color, uv, tint = np.ones((faces, 3, 3)), np.zeros((faces, 3, 2), np.float32), np.ones((faces, 3, 3))
        texture = np.full(faces, -1)
        for slot, made in enumerate(part.materials):
            here = part.material == slot
            if not here.any():
                continue
            own = part.tints[slot]
            if own is not None:
                tint[here] = np.clip(own[here], 0, 1)
            uv[here], color[here] = part.uv[slot][here], made.factor
            if made.image is None:
                continue
            if made.image.name not in known:
                known[made.image.name] = image_pixels(made.image, LARGEST_TEXTURE)
            pixels = known[made.image.name]
            if pixels is None:
                notes.append(f"the picture '{made.image.name}' is missing")
                continue
            key = (made.image.name, made.factor.tobytes())
            if key not in place:
                place[key] = len(images)
                images.append((255 * to_srgb(to_linear(pixels) * made.factor) + 0.5).astype(np.uint8))
            texture[here] = place[key]
            flat = sample_image(images[place[key]], uv[here].reshape(-1, 2).astype(np.float64))
            color[here] = to_linear(flat).reshape(-1, 3, 3)
        linear.append(color * tint)
        uvs.append(uv)
        chosen.append(texture)
        tints.append(tint)
    arrays = {"corner_rgb": (255 * to_srgb(np.concatenate(linear)) + 0.5).astype(np.uint8)}
    if images:
        arrays |= {"corner_uv": np.concatenate(uvs), "face_texture": np.concatenate(chosen).astype(np.int16)}
        arrays |= {f"texture_{k}": image for k, image in enumerate(images)}
        tint = np.concatenate(tints)
        if (tint < 1).any():
            arrays["corner_tint"] = (255 * tint + 0.5).astype(np.uint8)
    return arrays


def _uv(mesh: Any, name: str, loops: Array) -> Array:
    layer = mesh.uv_layers.get(name) if name else None
    if layer is None:
        layer = next((each for each in mesh.uv_layers if each.active_render), None) or mesh.uv_layers.active
    if layer is None:
        return np.zeros((*loops.shape, 2), np.float32)
    flat = np.empty(2 * len(mesh.loops), np.float32)
    layer.data.foreach_get("uv", flat)
    return flat.reshape(-1, 2)[loops]


def _tint(mesh: Any, name: str | None, faces: Array, loops: Array) -> Array | None:
    if name is None:
        return None
    layer = mesh.color_attributes.get(name) if name else mesh.color_attributes.active_color
    if layer is None:
        return None
    flat = np.empty(4 * len(layer.data), np.float32)
    layer.data.foreach_get("color", flat)  # linear, whatever it is stored as
    return flat.reshape(-1, 4)[loops if layer.domain == "CORNER" else faces][..., :3]
