# SPDX-License-Identifier: GPL-3.0-or-later
"""The plain colour of a material: its factor, texture and vertex colours, read off the nodes and never rendered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_SURFACES = ("Base Color", "Color")
"""Inputs of shaders that hold what we look for, the better one first."""
_FACTORS = ("Color", "Color1", "Color2", "A", "B", "Image")
_DEEPEST = 40


@dataclass(frozen=True)
class MaterialColor:
    """factor (3,): linear; image: None for none; uv: name of its UV map, "" for the mesh's own; layer: name of the
    colour attribute that it is multiplied by, None for none."""

    factor: Array
    image: Any = None
    uv: str = ""
    layer: str | None = None

    def times(self, other: MaterialColor) -> MaterialColor:
        """Product of the two; the first texture and colour attribute count."""
        first = self if self.image is not None else other
        layer = self.layer if self.layer is not None else other.layer
        return MaterialColor(self.factor * other.factor, first.image, first.uv, layer)


WHITE = MaterialColor(np.ones(3))


def material_color(material: bpy.types.Material | None) -> MaterialColor:
    """The colour of a material: of the shader that its output shows; grey where there is no material."""
    if material is None:
        return MaterialColor(np.full(3, 0.8))
    plain = MaterialColor(np.array(material.diffuse_color[:3], np.float64))
    if material.node_tree is None or not getattr(material, "use_nodes", True):
        return plain
    outputs: list[Any] = [node for node in material.node_tree.nodes if node.type == "OUTPUT_MATERIAL"]
    output = next((node for node in outputs if node.is_active_output), outputs[0] if outputs else None)
    source = None if output is None else _source(output.inputs["Surface"])
    return (source and _of_shader(source, 0)) or plain


def image_pixels(image: bpy.types.Image, most: int) -> Array | None:
    """sRGB pixels (H, W, 3) in [0, 1], top row first, at most `most` on a side; None where the picture is missing."""
    width, height = image.size
    if width == 0 or height == 0:
        return None
    flat = np.empty(width * height * image.channels, np.float32)
    try:
        image.pixels.foreach_get(flat)  # type: ignore[attr-defined]
    except RuntimeError:  # what Blender says where the file is gone
        return None
    pixels = flat.reshape(height, width, image.channels)[::-1]
    pixels = pixels[..., :3] if image.channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    step = -(-max(width, height) // most)
    if step > 1:
        rows, columns = max(height // step, 1), max(width // step, 1)
        tall, wide = min(step, height), min(step, width)
        pixels = pixels[: rows * tall, : columns * wide].reshape(rows, tall, columns, wide, 3).mean(axis=(1, 3))
    return np.clip(pixels, 0.0, 1.0)


def _source(socket: Any) -> Any:
    """The node behind an input, past reroutes and muted nodes; None where nothing is linked."""
    for _ in range(_DEEPEST):
        if not socket.is_linked:
            return None
        node = socket.links[0].from_node
        if node.type != "REROUTE" and not node.mute:
            return node
        inner = next((s for s in node.inputs if s.is_linked), None)
        if inner is None:
            return None
        socket = inner
    return None


def _of_shader(node: Any, depth: int) -> MaterialColor | None:
    """The colour of a shader: its own, or that of the first shader that is mixed in and has one."""
    if depth > _DEEPEST:
        return None
    for name in _SURFACES:
        socket = node.inputs.get(name)
        if socket is not None and socket.type == "RGBA" and node.type not in ("BSDF_TRANSPARENT", "HOLDOUT"):
            return _of_color(socket, depth + 1)
    for socket in node.inputs:
        inner = _source(socket) if socket.type == "SHADER" else None
        found = None if inner is None else _of_shader(inner, depth + 1)
        if found is not None:
            return found
    return None


def _of_color(socket: Any, depth: int) -> MaterialColor:
    """The colour that an input is given: a value, a texture, a colour attribute, or a product of these."""
    node = _source(socket)
    if node is None or depth > _DEEPEST:
        return WHITE if socket.is_linked else MaterialColor(np.array(socket.default_value[:3], np.float64))
    if node.type == "TEX_IMAGE":
        return MaterialColor(np.ones(3), node.image, _uv_map(node)) if node.image is not None else WHITE
    if node.type in ("VERTEX_COLOR", "ATTRIBUTE"):
        name = node.layer_name if node.type == "VERTEX_COLOR" else node.attribute_name
        return MaterialColor(np.ones(3), layer=name)
    if node.type == "RGB":
        return MaterialColor(np.array(node.outputs[0].default_value[:3], np.float64))
    colors = [s for s in node.inputs if s.type == "RGBA" and s.enabled and s.name in _FACTORS]
    if node.type in ("MIX", "MIX_RGB") and node.blend_type == "MULTIPLY" and len(colors) == 2:
        first, second = (_of_color(s, depth + 1) for s in colors)
        return first.times(second)
    # Corrections, blends and the like: what goes into them, the linked input first.
    for inner in sorted(colors, key=lambda s: not s.is_linked):
        return _of_color(inner, depth + 1)
    return WHITE


def _uv_map(node: Any) -> str:
    source = _source(node.inputs["Vector"])
    while source is not None and source.type == "MAPPING":
        source = _source(source.inputs["Vector"])
    return source.uv_map if source is not None and source.type == "UVMAP" else ""
