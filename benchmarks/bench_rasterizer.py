# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed of the CPU rasteriser, forward and forward + backward, beside a tiled torch version.

    python benchmarks/bench_rasterizer.py [--no-torch] [--ply SPLATS.ply]

Prints a Markdown table: wall ms per image with all threads, core-ms (processor time of all threads) and the core-ms
of torch on one thread. The synthetic object is a noisy ellipsoid shell seen from the four paper views.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import torch_rasterizer
from gskin_addon.core.render.camera import Camera, paper_views, percentile_bounds
from gskin_addon.core.render.cpu.backend import CpuScene, prepare, thread_count
from gskin_addon.core.render.photometric import photometric_loss
from gskin_addon.core.splats.morton import morton_order

SIZES = ((10_000, 256), (50_000, 256), (50_000, 512), (200_000, 512))
Splats = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def shell(count: int, seed: int = 0) -> Splats:
    """means, quats, scales, colors, opacities of an ellipsoid shell about as tall as a person."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    means = d / np.linalg.norm(d, axis=1, keepdims=True) * (0.45, 0.3, 0.9) * (1 - 0.1 * rng.random((count, 1)) ** 2)
    means = means[morton_order(means)]
    scales = np.exp(rng.normal(np.log(0.63 * np.sqrt(3.0 / count)), 0.5, (count, 3))) * (1, 1, 0.3)
    arrays = means, rng.normal(size=(count, 4)), scales, rng.random((count, 3)), rng.uniform(0.3, 1, count)
    return tuple(np.ascontiguousarray(a, np.float32) for a in arrays)  # type: ignore[return-value]


def load_ply(path: Path) -> Splats:
    """The same of a capture, in Morton order."""
    from gskin_addon.core.splats.ply import read_ply

    cloud = read_ply(path).cloud
    cloud = cloud.select(morton_order(cloud.means))
    return cloud.means, cloud.quats, cloud.scales, cloud.base_colors(), cloud.opacities


def measure(task: Callable[[int], object], repeats: int) -> tuple[float, float]:
    """Median wall ms and core-ms of task(k)."""
    task(0)
    wall, core = [], []
    for k in range(repeats):
        w, c = time.perf_counter(), time.process_time()
        task(k)
        wall.append(time.perf_counter() - w)
        core.append(time.process_time() - c)
    return 1e3 * float(np.median(wall)), 1e3 * float(np.median(core))


def pruned(splats: Splats, cameras: list[Camera]) -> Splats:
    """Without the splats whose blending weight stays below 0.01 in all views."""
    scene: CpuScene = prepare(splats[2], splats[3], splats[4])
    keep = np.max([scene.contribution(splats[0], splats[1], c) for c in cameras], axis=0) > 0.01
    return tuple(a[keep] for a in splats)  # type: ignore[return-value]


def row(name: str, splats: Splats, size: int, with_torch: bool) -> str:
    """One line of the table."""
    means, quats, scales, colors, opacities = splats
    cameras = paper_views(*percentile_bounds(means), size)
    scene = prepare(scales, colors, opacities)
    grad = np.random.default_rng(1).normal(size=(size, size, 3)).astype(np.float32)
    targets = [photometric_loss(scene.render(means, quats, c)[0]) for c in cameras]

    def both(k: int) -> None:
        scene.backward(scene.forward(means, quats, cameras[k % 4]), grad)

    forward = measure(lambda k: scene.forward(means, quats, cameras[k % 4]), 12)
    whole = measure(both, 12)
    seen = scene.render(means, quats, cameras[1])
    loss = measure(lambda k: targets[0](*seen), 8)
    cells = [
        name,
        str(size),
        f"{forward[0]:.1f} / {whole[0]:.1f}",
        f"{forward[1]:.1f} / {whole[1]:.1f}",
        f"{loss[1]:.1f}",
    ]
    if with_torch:
        t = [torch.from_numpy(a) for a in splats]
        white, g = torch.ones(3), torch.from_numpy(grad)

        def slow(k: int) -> None:
            m, q = t[0].clone().requires_grad_(), t[1].clone().requires_grad_()
            (torch_rasterizer.render(m, q, *t[2:], cameras[k % 4], white) * g).sum().backward()

        def slow_forward(k: int) -> None:
            with torch.no_grad():
                torch_rasterizer.render(*t, cameras[k % 4], white)

        same = torch_rasterizer.render(*t, cameras[1], white).numpy()
        if np.abs(same - seen[0]).mean() > 1e-4:
            raise RuntimeError("The two rasterisers draw different pictures; the comparison means nothing.")
        a, b = measure(slow_forward, 2), measure(slow, 2)
        cells.append(f"{a[1]:.0f} / {b[1]:.0f}")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--no-torch", action="store_true", help="leave out the torch version (it takes a minute)")
    parser.add_argument("--ply", type=Path, help="also time this capture, whole and pruned")
    args = parser.parse_args()
    torch.set_num_threads(1)  # core-ms without threads that spin while they wait
    print(f"{thread_count()} threads; ms per image, forward / forward + backward")
    print("| splats | px | ms | core-ms | L1 + D-SSIM core-ms |" + ("" if args.no_torch else " tiled torch core-ms |"))
    print("|---|---|---|---|---|" + ("" if args.no_torch else "---|"))
    for count, size in SIZES:
        print(row(f"{count // 1000}k", shell(count), size, not args.no_torch and count <= 50_000), flush=True)
    if args.ply:
        splats = load_ply(args.ply)
        cameras = paper_views(*percentile_bounds(splats[0]), 512)
        few = pruned(splats, cameras)
        print(row(f"{args.ply.stem}, {len(splats[0])}", splats, 512, False))
        print(row(f"{args.ply.stem} pruned, {len(few[0])}", few, 512, False))


if __name__ == "__main__":
    main()
