# SPDX-License-Identifier: GPL-3.0-or-later
"""The verdict on pictures of splats.py: against our own rasteriser with the same camera, and against one another."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from judging import Check, print_checks
from looks import changed, look, read

from gskin_addon.core.render.camera import Camera
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.splats.cloud import SplatCloud

OWN_DB, SCREEN_DB = 45.0, 38.0
"""Least PSNR of the drawing's own pixels and of the screenshot, which Blender blends with its background."""
EDGE = 8
"""Pixels along the edge of a screenshot that are not compared."""
FAR = 20_000.0
"""Metres to the perspective camera that stands for an orthographic one: rays differ by a hundredth of a pixel."""
SAME, OTHER = 0.002, 0.01
"""Largest share of pixels in which equal views differ; least share in which different ones do."""
ALIKE = (("s00_empty", "s14_hidden"), ("s00_empty", "s16_local_view_of_another"), ("s02_posed", "s15_shown"),
         ("s20_before", "s22_undone"), ("s20_before", "s23_saved"), ("s20_before", "s24_reloaded"))  # fmt: skip
UNLIKE = (("s00_empty", "s01_rest"), ("s01_rest", "s02_posed"), ("s20_before", "s21_turned"))
FAINT = (("s11_no_bones", "s12_bones"), ("s11_no_bones", "s13_selected"))
"""Pairs that differ by a few lines only: bones in front, and the outline of what is selected."""


def judge_splats(out: Path) -> list[Check] | None:
    """Print and return the checks; None where the session did not come to its end."""
    path = out / "result.json"
    if not path.is_file():
        return None
    result = json.loads(path.read_text())
    checks: list[Check] = [*map(tuple, result["checks"])]
    views = result["views"]
    for shot in sorted(out.glob("s*.npz")):
        checks += compare(shot, read(shot.with_suffix(".png"), views[shot.stem]), views[shot.stem])
    for first, second in (*ALIKE, *UNLIKE, *FAINT):
        if not {first, second} <= views.keys():
            checks.append((f"{first} and {second} were taken", False, ""))
            continue
        pair = [read(out / f"{name}.png", views[name]) for name in (first, second)]
        share = changed(*pair)
        if (first, second) in ALIKE:
            checks.append((f"{first} and {second} are alike", share < SAME, f"{share:.2%}"))
        elif (first, second) in UNLIKE:
            checks.append((f"{first} and {second} differ", share > OTHER, f"{share:.2%}"))
        else:
            checks.append((f"{first} and {second} differ by lines", 2e-4 < share < 0.05, f"{share:.2%}"))
    for name in ("s80_failed", "s90_off"):
        if name not in views:
            checks.append((f"{name} was taken", False, ""))
            continue
        seen = look(read(out / f"{name}.png", views[name]))
        checks.append((f"{name} shows ellipsoids", seen.filled > 0.02 and seen.colours > 1000, str(seen)))
    print_checks(checks)
    for name, value in result["numbers"].items():
        print(f"{name:>28}  {value:.4g}")
    return checks


def compare(shot: Path, screen: np.ndarray, box: list[int]) -> list[Check]:
    """Checks of one measured view; the reference's picture is written beside it."""
    with np.load(shot) as data:
        cloud = SplatCloud(*(data[name] for name in ("means", "quats", "scales", "opacities", "sh")))
        own = data["own"].astype(np.float32)
        camera = as_camera(data["view"], data["projection"], *map(int, data["size"]))
    colours, counts = np.unique(screen.reshape(-1, 3), axis=0, return_counts=True)
    background = colours[counts.argmax()] / 255.0
    wanted, alpha = render_cloud(cloud, camera, background)
    mine = np.clip(own[..., :3] + (1 - own[..., 3:]) * background, 0, 1)
    # The screenshot lacks the rows below the view's header.
    height, width = screen.shape[:2]
    part = wanted[-height:, :width]
    from PIL import Image

    both = np.concatenate([screen, (part * 255 + 0.5).astype(np.uint8)], axis=1)
    Image.fromarray(both).save(shot.with_name(f"{shot.stem}_beside.png"))
    # Blender rounds the corners of an area and lays a line along its edge.
    inner = slice(EDGE, -EDGE), slice(EDGE, -EDGE)
    drawn, shown = psnr(mine, wanted), psnr(screen[inner] / 255.0, part[inner])
    cover = float((alpha > 0.5).mean())
    return [
        (f"{shot.stem} shows splats", cover > 0.03, f"{cover:.0%}"),
        (f"{shot.stem}: drawn", drawn > OWN_DB, f"{drawn:.1f} dB"),
        (f"{shot.stem}: on the screen", shown > SCREEN_DB, f"{shown:.1f} dB"),
    ]


def as_camera(view: np.ndarray, projection: np.ndarray, height: int, width: int) -> Camera:
    """The camera of Blender's matrices (4, 4); for parallel rays one that is very far away."""
    flip = np.diag([1.0, -1.0, -1.0])
    rotation, translation = flip @ view[:3, :3], flip @ view[:3, 3]
    fx, fy = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    if projection[3, 3] == 0.0:
        cx, cy = (1 - projection[0, 2]) * width / 2, (1 + projection[1, 2]) * height / 2
    else:
        cx, cy = (1 + projection[0, 3]) * width / 2, (1 - projection[1, 3]) * height / 2
        translation = np.array([*translation[:2], translation[2] + FAR])
        fx, fy = fx * translation[2], fy * translation[2]
    return Camera(rotation, translation, fx, fy, cx, cy, width, height)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two pictures in 0..1."""
    return float(-10 * np.log10(max(np.mean((a.astype(np.float64) - b) ** 2), 1e-12)))
