# SPDX-License-Identifier: GPL-3.0-or-later
"""The marks of Edit Mode over true splats: which points are selected, in Blender's own colours and sizes.

Blender draws all points and edges of the fabric, so many that nothing is left to be seen of a figure. Here what is
selected is drawn, on the side that selecting without X-ray reaches: what lies behind the fabric's triangles is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import mathutils
import numpy as np
from numpy.typing import NDArray

from .shaders import gpu_state, gpu_types, mark_shader, occluder_shader, square
from .textures import texel_texture

Array = NDArray[Any]

FEW = 4_000
"""Points in the view up to which those not selected are drawn, too: they lie apart then, and can be clicked."""
MOST = 60_000
"""Dots of one kind, and lines, that are drawn."""
FAINTEST = 0.5
"""How opaque marks are where they cover all of the splats that are selected."""
BIAS = 1.0
"""How far marks are drawn before the fabric, in usual lengths of its edges: its triangles meet in the points."""


@dataclass(frozen=True)
class Cage:
    """The points of one object as Edit Mode shows them.

    points (N, 3) in the object's space, matrix (4, 4) to the world; selected (N,), hidden (N,); active: the point that
    was clicked last, -1 for none; triangles (T, 3), edges (E, 2) of its fabric, of both none without one. key: equal
    for equal cages; solid_key: for equal triangles in equal places.
    """

    points: Array
    matrix: Array
    selected: Array
    hidden: Array
    active: int
    triangles: Array
    edges: Array
    key: Any
    solid_key: Any


@dataclass(frozen=True)
class Look:
    """Colours (sRGB) of the theme, and the diameter of a dot in pixels."""

    point: tuple[float, float, float]
    selected: tuple[float, float, float]
    edge: tuple[float, float, float]
    active: tuple[float, float, float]
    size: float


def theme_look(context: bpy.types.Context) -> Look:
    """As the theme has it for Edit Mode."""
    theme: Any = context.preferences.themes[0].view_3d
    point, selected, edge, active = (
        tuple(color)[:3] for color in (theme.vertex, theme.vertex_select, theme.edge_select, theme.editmesh_active)
    )
    return Look(point, selected, edge, active, theme.vertex_size * context.preferences.system.pixel_size)


@dataclass(frozen=True)
class Strokes:
    """What is drawn, in this order: start and end (M, 3) in normalised device coordinates, color (M, 3), radius (M,) in
    pixels, rim (M,) whether there is a dark one. opacity: of all of it."""

    start: Array
    end: Array
    color: Array
    radius: Array
    rim: Array
    opacity: float


def lay_out(cages: Sequence[Cage], view: Array, projection: Array, size: tuple[int, int], look: Look) -> Strokes:
    """The marks of cages in a view; a dot is a stroke without length."""
    parts: list[tuple[Array, Array, tuple[float, float, float], float, bool]] = []
    last: list[tuple[Array, Array, tuple[float, float, float], float, bool]] = []
    total, selected_places = 0, []
    placed = []
    for cage in cages:
        places, seen = _project(cage, view, projection)
        placed.append((cage, places, seen))
        total += int(seen.sum())
    radius = look.size / 2 + 0.5
    for cage, places, seen in placed:
        if total <= FEW:
            dots = places[seen & ~cage.selected]
            parts.append((dots, dots, look.point, radius - 0.5, False))
        chosen = seen & cage.selected
        selected_places.append(places[chosen])
        lines = cage.edges[cage.selected[cage.edges].all(axis=1) & seen[cage.edges].all(axis=1)]
        if len(lines) <= MOST:
            parts.append((places[lines[:, 0]], places[lines[:, 1]], look.edge, 0.6, False))
        dots = _some(places[chosen])
        parts.append((dots, dots, look.selected, radius, True))
        if cage.active >= 0 and chosen[cage.active]:
            dots = places[[cage.active]]
            last.append((dots, dots, look.active, radius, True))
    parts += last
    count = [len(start) for start, *_ in parts]
    opacity = _opacity(np.concatenate(selected_places), size, look.size)
    rims = [part[4] and opacity == 1.0 for part in parts]  # of dots side by side only dark would be left
    return Strokes(
        np.concatenate([start for start, *_ in parts]), np.concatenate([part[1] for part in parts]),
        np.repeat(np.array([part[2] for part in parts]), count, axis=0),
        np.repeat([part[3] for part in parts], count), np.repeat(rims, count), opacity,
    )  # fmt: skip


def _some(places: Array) -> Array:
    return places[:: -(-len(places) // MOST)] if len(places) > MOST else places


def _opacity(places: Array, size: tuple[int, int], dot: float) -> float:
    """1 where dots lie apart, less where they would hide the splats: by how often they cover their bounds."""
    if len(places) < 2:
        return 1.0
    width, height = (np.ptp(places[:, :2], axis=0) / 2 * size).tolist()
    return float(np.clip(max(width * height, 1.0) / (len(places) * dot**2), FAINTEST, 1.0))


def _project(cage: Cage, view: Array, projection: Array) -> tuple[Array, Array]:
    """Normalised device coordinates (N, 3) of the points, drawn nearer by `BIAS`, and whether each is in the view."""
    m = view @ cage.matrix
    points = cage.points @ m[:3, :3].T.astype(np.float32) + m[:3, 3].astype(np.float32)
    p = projection.astype(np.float32)
    x, y, z = points.T
    w = p[3, 2] * z + p[3, 3]
    nearer = z + np.float32(bias(cage))
    deep = p[3, 2] * nearer + p[3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.stack(
            ((p[0, 0] * x + p[0, 2] * z + p[0, 3]) / w, (p[1, 1] * y + p[1, 2] * z + p[1, 3]) / w,
             (p[2, 2] * nearer + p[2, 3]) / deep), axis=1,
        )  # fmt: skip
    seen = (w > 0) & (deep > 0) & (np.abs(places[:, 0]) < 1) & (np.abs(places[:, 1]) < 1) & ~cage.hidden
    return places, seen


def bias(cage: Cage) -> float:
    """Length in view space by which the marks of a cage are drawn nearer."""
    if not len(cage.edges):
        return 0.0
    some = cage.edges[:: max(1, len(cage.edges) // 2_000)]
    lengths = np.linalg.norm(cage.points[some[:, 0]] - cage.points[some[:, 1]], axis=1)
    return BIAS * float(np.median(lengths)) * float(np.cbrt(abs(np.linalg.det(cage.matrix[:3, :3]))))


class Marks:
    """The marks of one view, in a picture of their own that is kept while it is right."""

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        self.texture = gpu_types.GPUTexture((width, height), format="RGBA16F")
        depth = gpu_types.GPUTexture((width, height), format="DEPTH_COMPONENT32F")
        self.opacity = 1.0
        self._framebuffer = gpu_types.GPUFrameBuffer(depth_slot=depth, color_slots=[self.texture])
        self._drawn_for: Any = None
        self._solid_for: Any = None
        self._batches: dict[Any, Any] = {}

    def draw(
        self, cages: Sequence[Cage], view: Array, projection: Array, look: Look, *, through: bool
    ) -> None:  # fmt: skip
        """Bring the picture up to date; through: also what lies behind the fabric is seen, as in X-ray."""
        here = view.tobytes(), projection.tobytes()
        drawn_for = (tuple(cage.key for cage in cages), here, look, through)
        if self._drawn_for == drawn_for:
            return
        strokes = lay_out(cages, view, projection, self.size, look)
        before = gpu_state.blend_get(), gpu_state.depth_test_get(), gpu_state.depth_mask_get(), gpu_state.viewport_get()
        with self._framebuffer.bind():
            try:
                gpu_state.viewport_set(0, 0, *self.size)
                solid_for = (tuple(cage.solid_key for cage in cages), here)
                if not through and len(strokes.start) and self._solid_for != solid_for:
                    self._draw_solid(cages, view, projection)
                    self._solid_for = solid_for
                self._framebuffer.clear(color=(0.0, 0.0, 0.0, 0.0))
                gpu_state.blend_set("ALPHA_PREMULT")
                gpu_state.depth_test_set("NONE" if through else "LESS_EQUAL")
                gpu_state.depth_mask_set(False)
                _draw_strokes(strokes, self.size)
            finally:
                gpu_state.blend_set(before[0])
                gpu_state.depth_test_set(before[1])
                gpu_state.depth_mask_set(before[2])
        gpu_state.viewport_set(*before[3])
        self.opacity, self._drawn_for = strokes.opacity, drawn_for

    def _draw_solid(self, cages: Sequence[Cage], view: Array, projection: Array) -> None:
        """The depths of the fabrics' triangles."""
        self._framebuffer.clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
        gpu_state.blend_set("NONE")
        gpu_state.depth_test_set("LESS_EQUAL")
        gpu_state.depth_mask_set(True)
        shader = occluder_shader()
        kept = {cage.solid_key: self._batches.get(cage.solid_key) for cage in cages if len(cage.triangles)}
        self._batches = {key: batch or _solid(cages, key) for key, batch in kept.items()}
        for cage in cages:
            if cage.solid_key in self._batches:
                shader.bind()
                shader.uniform_float("to_clip", mathutils.Matrix((projection @ view @ cage.matrix).tolist()))
                self._batches[cage.solid_key].draw(shader)


def _solid(cages: Sequence[Cage], key: Any) -> Any:
    cage = next(cage for cage in cages if cage.solid_key == key)
    shown = cage.triangles
    if cage.hidden.any():
        shown = shown[~cage.hidden[shown].any(axis=1)]
    form = gpu_types.GPUVertFormat()
    form.attr_add(id="point", comp_type="F32", len=3, fetch_mode="FLOAT")
    points = gpu_types.GPUVertBuf(form, len(cage.points))
    points.attr_fill("point", np.ascontiguousarray(cage.points, np.float32))
    corners = gpu_types.GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(shown, np.int32))
    return gpu_types.GPUBatch(type="TRIS", buf=points, elem=corners)


def _draw_strokes(strokes: Strokes, size: tuple[int, int]) -> None:
    count = len(strokes.start)
    if not count:
        return
    texels = np.empty((count, 3, 4), np.float32)
    texels[:, 0, :3], texels[:, 0, 3] = strokes.start, strokes.radius
    texels[:, 1, :3], texels[:, 1, 3] = strokes.end, strokes.rim
    texels[:, 2, :3], texels[:, 2, 3] = strokes.color, 1.0
    shader, texture = mark_shader(), texel_texture(texels.reshape(-1, 4))  # not kept, it is gone too early
    shader.bind()
    shader.uniform_sampler("strokes", texture)
    shader.uniform_float("size", size)
    square().draw_instanced(shader, instance_start=0, instance_count=count)
