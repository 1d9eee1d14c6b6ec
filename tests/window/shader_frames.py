# SPDX-License-Identifier: GPL-3.0-or-later
"""*Render Splats* by the shader against the rasteriser: perspective and parallel rays, alone and behind other objects.

xvfb-run -a PYTHON tests/window/shader_frames.py [--splats FILE.ply]      needs bpy >= 5.2 and OpenGL (Mesa)

The add-on is that of this repository. Without a file: made-up splats of degree 3. Exit code 1 where a picture is less
than 40 dB near.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import bpy
import gpu
import numpy as np

from gskin_addon.core.render.camera import Camera, look_at, percentile_bounds
from gskin_addon.core.render.drawn_splats import drawn_cloud
from gskin_addon.core.render.frame import Frame, draw_frame
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.formats import read_splats
from gskin_addon.session.render_job import drawn_by_shader

LEAST = 40.0
"""dB of colour and alpha, premultiplied."""
SIZE = (400, 480)


def made_up(count: int = 4000) -> SplatCloud:
    """Splats of all sizes with harmonics of degree 3, about two metres wide."""
    rng = np.random.default_rng(4)
    return SplatCloud(
        rng.normal(0.0, 0.5, (count, 3)).astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        np.exp(rng.normal(-3.5, 0.7, (count, 3))).astype(np.float32), rng.uniform(0.05, 1.0, count).astype(np.float32),
        rng.normal(0.0, 0.3, (count, 16, 3)).astype(np.float32),
    )  # fmt: skip


def cameras(cloud: SplatCloud) -> dict[str, Camera]:
    """A camera with perspective and one with parallel rays that see the same, both with a shifted lens."""
    lower, upper = percentile_bounds(cloud.means)
    middle, size = 0.5 * (lower + upper), float(np.max(upper - lower))
    seen = look_at(middle + size * np.array([-1.7, -0.5, 0.3]), middle, size=SIZE)
    seen = replace(seen, cx=0.45 * seen.width, cy=0.55 * seen.height)
    straight = replace(seen, orthographic=True, fx=0.7 * SIZE[0] / size, fy=0.7 * SIZE[0] / size)
    return {"perspective": seen, "orthographic": straight}


def walls(cloud: SplatCloud) -> np.ndarray:
    """Two slanted triangles through the splats."""
    lower, upper = percentile_bounds(cloud.means)
    middle, size = 0.5 * (lower + upper), float(np.max(upper - lower))
    corners = np.array([[[0, -0.5, -0.5], [0.2, 0.4, -0.4], [-0.3, 0.1, 0.5]],
                        [[-0.6, 0, 0], [0.1, 0.5, 0.1], [0.1, -0.4, 0.3]]])  # fmt: skip
    return (middle + size * corners).astype(np.float32)


def main() -> int:
    """Compare; returns the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--splats", type=Path)
    options = parser.parse_args()
    gpu.init()
    cloud = made_up()
    if options.splats:
        cloud = rotate_cloud(read_splats(options.splats).cloud, up_rotation("-y"))
    splats = [drawn_cloud(cloud, np.eye(4))]
    worst = np.inf
    for name, camera in cameras(cloud).items():
        for behind, triangles in (("", np.zeros((0, 3, 3), np.float32)), (", behind others", walls(cloud))):
            frame = Frame(splats, camera, triangles, 100.0)
            wanted, hidden = draw_frame(frame)
            got, same = draw_frame(drawn_by_shader(frame))
            assert (hidden == same).all()
            error = np.concatenate([got.color - wanted.color, (got.alpha - wanted.alpha)[..., None]], axis=2)
            near = float(-10.0 * np.log10(np.mean(error**2)))
            worst = min(worst, near)
            word = "ok   " if near >= LEAST else "FAIL "
            print(f"{word} {bpy.app.version_string}: {name}{behind}: {near:.1f} dB", flush=True)
    return 0 if worst >= LEAST else 1


try:
    code = main()
except BaseException:
    traceback.print_exc()
    code = 1
# Python's own end crashes in the driver once Blender has drawn.
os._exit(code)
