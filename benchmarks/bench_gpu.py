# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed of the rasterisers on a CUDA GPU, alone and in whole learning schedules.

    python benchmarks/bench_gpu.py [--runs 3] [--splats 50000] [--bones 20]

Prints the GPU's name and lines `name value target ok|MISS`: medians of --runs runs, wall time with the device
waited for. Without a CUDA device it says so and measures nothing; `--on-cpu` then runs Warp's kernels on the
processor, on one thread, to see that the benchmark itself works.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.bench_rasterizer import shell
from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.render.backends import WARP_DEVICE, cuda_device, resolve_backend
from gskin_addon.core.render.camera import paper_views, percentile_bounds
from gskin_addon.core.render.cpu import backend as cpu
from gskin_addon.core.render.photometric import photometric_loss
from gskin_addon.core.render.rasterizer import prepare
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skinning.fields import create_field
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser, Target
from gskin_addon.core.skinning.presets import PRESETS, Preset
from gskin_addon.core.splats.cloud import SH_C0, SplatCloud

IMAGES, SIZE = 20, 512
IMAGE_MS, SCHEDULES = 3.0, {"standard": 5.0, "thorough": 30.0}
"""Bars: ms per image with its loss and gradients; seconds of the learning in a preset."""


@dataclass(frozen=True)
class Task:
    """A shell of splats about a chain of bones, with weights (N, B) to find and others to start from."""

    cloud: SplatCloud
    skeleton: Skeleton
    start: np.ndarray
    truth: np.ndarray


def make_task(splats: int, bones: int) -> Task:
    """Bones lie one on the other along z; true weights fall off twice as fast as those at the start."""
    means, quats, scales, colors, opacities = shell(splats)
    diagonal = float(np.linalg.norm(np.ptp(means, axis=0)))
    cloud = SplatCloud(means / diagonal, quats, scales / diagonal, opacities, (colors[:, None] - 0.5) / SH_C0)
    low, high = cloud.means[:, 2].min(), cloud.means[:, 2].max()
    ends = np.linspace(low, high, bones + 1)
    at = np.zeros((bones + 1, 3))
    at[:, 2] = ends
    skeleton = Skeleton(tuple(f"bone{b}" for b in range(bones)), np.arange(bones) - 1, at[:-1], at[1:])
    away = np.abs(cloud.means[:, 2:] - 0.5 * (ends[:-1] + ends[1:])) / (ends[1] - ends[0])
    start, truth = (np.exp(-k * away**2) for k in (1.0, 4.0))
    weights = [(w / w.sum(1, keepdims=True)).astype(np.float32) for w in (start, truth)]
    return Task(cloud, skeleton, weights[0], weights[1])


def median_seconds(task: Callable[[], object], runs: int) -> float:
    """Of `runs` runs after one that does not count; each ends with numbers on the CPU, so the device is done."""
    task()
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        task()
        seconds.append(time.perf_counter() - begun)
    return float(np.median(seconds))


def line(name: str, value: float, target: float) -> None:
    print(f"{name} {value:.3g} {target:g} {'ok' if value <= target else 'MISS'}", flush=True)


def bench_images(backend: str, task: Task, size: int, runs: int) -> None:
    """A batch of images with loss and gradients, and its distance from the CPU's."""
    cloud, count = task.cloud, 3
    constant = cloud.scales, cloud.base_colors(), cloud.opacities
    scene, reference = prepare(*constant, backend=backend), cpu.prepare(*constant)
    views = paper_views(*percentile_bounds(cloud.means), size)
    cameras = [views[p % 4] for p in range(IMAGES)]
    rng = np.random.default_rng(0)
    means = (cloud.means + rng.normal(0, 1e-3, (IMAGES, *cloud.means.shape))).astype(np.float32)
    quats = np.repeat(cloud.quats[None], IMAGES, axis=0)
    targets = [(reference.render(cloud.means, cloud.quats, c)[0].clip(0, 1) * 255).astype(np.uint8) for c in views]
    losses = [photometric_loss(targets[p % 4]) for p in range(IMAGES)]
    mine = scene.render_and_grad_many(means[:count], quats[:count], cameras[:count], losses[:count])
    theirs = reference.render_and_grad_many(means[:count], quats[:count], cameras[:count], losses[:count])
    for name, a, b in zip(("loss", "means_gradient", "quats_gradient"), mine, theirs, strict=True):
        line(f"gpu_{backend}_{name}_error", float(np.linalg.norm(a - b) / np.linalg.norm(b)), 1e-3)
    arrays = median_seconds(lambda: scene.render_and_grad_many(means, quats, cameras, losses), runs)
    print(f"gpu_{backend}_image_ms_from_arrays {1e3 * arrays / IMAGES:.3g}")
    device = getattr(scene, "tensor_device", "")
    if device:
        import torch

        if device == "cpu" or torch.cuda.is_available():
            tensors = [torch.from_numpy(a).to(device) for a in (means, quats)]

            def step() -> None:
                grads = scene.render_and_grad_tensors(*tensors, cameras, losses)[1:]
                sum(float(g.sum()) for g in grads)

            line(f"gpu_{backend}_image_ms", 1e3 * median_seconds(step, runs) / IMAGES, IMAGE_MS)


def bench_schedule(
    backend: str, task: Task, name: str, preset: Preset, target: float, size: int, runs: int
) -> None:
    """The learning of a preset from perfect guidance images, without their making."""
    cameras = paper_views(*percentile_bounds(task.cloud.means), size)
    signals = make_signals(task.skeleton, cameras, preset.poses_per_view, np.random.default_rng(0))
    context = GuidanceContext(task.cloud, task.skeleton, task.start, task.start)
    images = Oracle(context, task.truth).images(signals)
    targets = [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]
    seconds, losses = [], []
    for _ in range(runs):
        field = create_field(preset.field, task.cloud.means, task.start)
        options = LearningOptions(rasterizer=backend)
        optimiser = Optimiser(task.cloud, task.skeleton, field, targets, preset, options=options)
        begun = time.perf_counter()
        losses = [optimiser.step()["render"] for _ in range(preset.iterations)]
        seconds.append(time.perf_counter() - begun)
    print(f"gpu_{backend}_{name}_loss_first_last {losses[0]:.4g} {losses[-1]:.4g}")
    line(f"gpu_{backend}_{name}_seconds", float(np.median(seconds)), target)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--splats", type=int, default=50_000)
    parser.add_argument("--bones", type=int, default=20)
    parser.add_argument("--on-cpu", action="store_true", help="try the benchmark itself, with small images")
    options = parser.parse_args()
    if options.on_cpu:
        os.environ[WARP_DEVICE] = "cpu"
    elif not cuda_device():
        print("There is no CUDA device here: nothing was measured.")
        return
    print("Warp's kernels on one thread of the processor" if options.on_cpu else cuda_device())
    task = make_task(options.splats, options.bones)
    size = 64 if options.on_cpu else SIZE
    for backend in ("warp",):
        try:
            resolve_backend(backend)
        except InputError as error:
            print(error)
            continue
        bench_images(backend, task, size, options.runs)
        for name, target in SCHEDULES.items():
            preset = PRESETS[name]
            if options.on_cpu:
                preset = replace(preset, stages=((size // 2, 2), (size, 2)), poses_per_view=2)
            bench_schedule(backend, task, name, preset, target, size, options.runs)


if __name__ == "__main__":
    main()
