# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport's drawing of splats costs, part by part, in a window of a real Blender.

xvfb-run -a blender --window-geometry 0 0 1600 900 --python benchmarks/bench_viewport.py

Random splats in a ball that fills the view. Milliseconds by the clock and of processor time, which a software driver
spends on drawing too; medians of five.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import bpy
import gpu
import numpy as np

from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.drawn_splats import DrawnSplats
from gskin_addon.core.render.screen_space import camera_matrices
from gskin_addon.core.render.view_order import back_to_front, eye_of, view_colors, view_depths
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.scene.display_inputs import BY_SHADER
from gskin_addon.scene.node_groups import set_display
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.scene.viewport.drawing import draw_into, make_target, read_target
from gskin_addon.scene.viewport.reading import read_posed, read_rest
from gskin_addon.scene.viewport.textures import color_texture, order_texture, pose_textures

WIDTH, HEIGHT = 1598, 875
COUNTS = (40_000, 152_000, 500_000)
REPEATS = 5


def made_up(count: int, degree: int) -> DrawnSplats:
    """Splats of about a pixel to ten in a ball of radius 1, turned by bones."""
    random = np.random.default_rng(0)
    points = random.normal(size=(count, 3))
    points *= (random.uniform(size=count) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    quats = random.normal(size=(2, count, 4)).astype(np.float32)
    # As many as there are cover a surface, each is smaller.
    scales = np.exp(random.normal(-0.5, 0.5, (count, 3))) * 0.6 / np.sqrt(count)
    sh = random.normal(0, 0.2, (count, (degree + 1) ** 2, 3))
    return DrawnSplats(
        points.astype(np.float32), quats[0], scales.astype(np.float32),
        random.uniform(0.2, 1.0, count).astype(np.float32), sh.astype(np.float32), turns=quats[1],
    )  # fmt: skip


def measure(work: Callable[[], Any]) -> tuple[float, float]:
    """Median milliseconds by the clock and of processor time."""
    seen = []
    for _ in range(REPEATS):
        clock, busy = time.perf_counter(), time.process_time()
        work()
        seen.append((1e3 * (time.perf_counter() - clock), 1e3 * (time.process_time() - busy)))
    wall, core = np.median(seen, axis=0)
    return float(wall), float(core)


def evaluation(splats: DrawnSplats) -> dict[str, Callable[[], Any]]:
    """What Blender and we do for a new pose beside the rig itself: the display's nodes, and reading what they give."""
    for old in list(bpy.data.objects):
        bpy.data.objects.remove(old)
    cloud = SplatCloud(splats.points, splats.rotations, splats.scales, splats.opacities, splats.sh)
    obj = create_splat_object(cloud, "Splats")
    set_display(obj, "Viewport Limit", splats.count)
    set_display(obj, BY_SHADER, True)
    layer = bpy.context.view_layer
    layer.update()
    rest = read_rest(obj, splats.count)

    def evaluate() -> None:
        obj.update_tag(refresh={"DATA"})
        layer.update()

    return {
        "the display's nodes": evaluate,
        "reading a pose": lambda: read_posed(obj.evaluated_get(layer.depsgraph), rest, splats.count),
    }


def main() -> None:
    """Print a table for each number of splats."""
    print(f"Blender {bpy.app.version_string}, {gpu.platform.backend_type_get()}, {gpu.platform.renderer_get()}")
    view, projection = camera_matrices(look_at((0.0, -3.6, 0.0), (0, 0, 0), size=(HEIGHT, WIDTH)))
    target = make_target(WIDTH, HEIGHT)
    for count in COUNTS:
        splats, colored = made_up(count, 0), made_up(count, 3)

        order = back_to_front(view_depths(splats, view))
        colors = view_colors(splats, eye_of(view, projection, splats.matrix))
        pose, ordered = pose_textures([splats]), order_texture(order)
        painted = color_texture([(colors, splats.opacities)])

        def draw(pose: Any = pose, ordered: Any = ordered, painted: Any = painted) -> None:
            draw_into(target, pose, [np.eye(4)], ordered, painted, view, projection)
            read_target(target)

        parts = {
            "order (thread)": lambda s=splats: back_to_front(view_depths(s, view)),
            "colours, degree 3, turned (thread)": lambda s=colored: view_colors(s, eye_of(view, projection, s.matrix)),
            "upload of order": lambda o=order: order_texture(o),
            "upload of colours": lambda s=splats, c=colors: color_texture([(c, s.opacities)]),
            "upload of a pose": lambda s=splats: pose_textures([s]),
            "draw and read back": draw,
            "read back alone": lambda: read_target(target),
            **evaluation(splats),
        }
        print(f"{count} splats, {WIDTH} x {HEIGHT}")
        for name, work in parts.items():
            wall, core = measure(work)
            print(f"  {name:<36}{wall:8.1f} ms{core:8.1f} core-ms", flush=True)


def start() -> None:
    """Timer: once the window is there."""
    try:
        main()
    except Exception:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


bpy.app.timers.register(start, first_interval=1.0)
