# SPDX-License-Identifier: GPL-3.0-or-later
"""`make bench-speed`: every bar of speed and memory as `name value target ok|MISS`, with core-time beside.

    python -m benchmarks.bench_speed [--only NAME,...] [--repeats 3] [--quick] [--write docs/benchmarks.md]

Values are medians of --repeats runs (at least 3 for numbers that are reported). Seconds are wall seconds, with the
core-seconds of all threads in brackets; ratios and errors have none. The subject is a made-up figure of tubes
(`benchmarks/figure.py`), the guidance the built-in one. Names begin like those in BARS; --quick leaves out the
ones that take minutes; --write puts the lines between `<!-- speed:begin -->` and `<!-- speed:end -->`.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch

from benchmarks import bench_gpu, bench_response, torch_rasterizer
from benchmarks.bench_rasterizer import measure, shell
from benchmarks.figure import figure
from benchmarks.jobs import Cost, run_job
from benchmarks.markers import write_between
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.oracle import Oracle
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.pipeline.steps import to_unit_size
from gskin_addon.core.render.backends import cuda_device
from gskin_addon.core.render.camera import paper_views, percentile_bounds
from gskin_addon.core.render.cpu.backend import prepare
from gskin_addon.core.render.cpu.threads import thread_count
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.render.reference import render as render_slowly
from gskin_addon.core.skinning.fields import create_field
from gskin_addon.core.skinning.initial import initial_weights
from gskin_addon.core.skinning.optimise import LearningOptions, Optimiser, Target, visibility_schedule
from gskin_addon.core.skinning.presets import Preset
from gskin_addon.core.skinning.subset import choose_subset

SPLATS, BONES, SIZE = 50_000, 20, 512
BATCH, POSES = 4, 24


@dataclass(frozen=True)
class Bar:
    """One line. value against target, the smaller (or for `least` the larger) the better; core: core-seconds."""

    name: str
    value: float
    target: float | None
    core: float | None = None
    least: bool = False

    def __str__(self) -> str:
        core = "" if self.core is None else f" ({self.core:.3g} core)"
        if self.target is None:
            return f"{self.name} {self.value:.3g} -{core}"
        good = self.value >= self.target if self.least else self.value <= self.target
        return f"{self.name} {self.value:.3g} {self.target:g} {'ok' if good else 'MISS'}{core}"


def rasterizer_bars(repeats: int) -> Iterator[Bar]:
    """Forward + backward beside the tiled torch version, in one run: core-milliseconds, so threads do not count."""
    torch.set_num_threads(1)
    splats = shell(SPLATS)
    means, quats, scales, colors, opacities = splats
    cameras = paper_views(*percentile_bounds(means), SIZE)
    scene = prepare(scales, colors, opacities)
    grad = np.random.default_rng(1).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    t, white, g = [torch.from_numpy(a) for a in splats], torch.ones(3), torch.from_numpy(grad)

    def fast(k: int) -> None:
        scene.backward(scene.forward(means, quats, cameras[k % 4]), grad)

    def slow(k: int) -> None:
        m, q = t[0].clone().requires_grad_(), t[1].clone().requires_grad_()
        (torch_rasterizer.render(m, q, *t[2:], cameras[k % 4], white) * g).sum().backward()

    seen = scene.forward(means, quats, cameras[1]).image
    same = torch_rasterizer.render(*t, cameras[1], white).numpy()
    if np.abs(same - seen).mean() > 1e-4:
        raise RuntimeError("The two rasterisers draw different pictures; the comparison means nothing.")
    mine, theirs = measure(fast, max(8, 4 * repeats)), measure(slow, repeats)
    yield Bar("rasterizer_core_ms", mine[1], None)
    yield Bar("rasterizer_over_torch", theirs[1] / mine[1], 40, least=True)


def gradient_bars(repeats: int) -> Iterator[Bar]:
    """Image and gradients against brute force in float64, on small scenes; the median scene."""
    image, relative = [], []
    for seed in range(max(repeats, 3)):
        splats = shell(300, seed)
        camera = paper_views(*percentile_bounds(splats[0]), 64)[seed % 4]
        pull = np.random.default_rng(seed).normal(size=(64, 64, 3))
        exact = [torch.from_numpy(a.astype(np.float64)) for a in splats]
        m, q = (a.requires_grad_() for a in exact[:2])
        wanted = render_slowly(m, q, *exact[2:], camera, torch.ones(3, dtype=torch.float64))[0]
        (wanted * torch.from_numpy(pull)).sum().backward()
        scene = prepare(*splats[2:])
        frame = scene.forward(splats[0], splats[1], camera)
        found = scene.backward(frame, pull.astype(np.float32))
        image.append(float(np.abs(frame.image - wanted.detach().numpy()).mean()))
        pairs = zip(found, (m.grad, q.grad), strict=True)
        relative.append(max(float(np.linalg.norm(a - b.numpy()) / np.linalg.norm(b.numpy())) for a, b in pairs))
    yield Bar("image_error", float(np.median(image)), 1e-4)
    yield Bar("gradient_error", float(np.median(relative)), 1e-4)


def make_optimiser(splats: int, bones: int, size: int, batch: int, poses: int = POSES, views: int = 4) -> Optimiser:
    """An optimiser on the figure with perfect guidance images of `views` views, at one image size."""
    asset = figure(splats, bones)
    whole, skeleton = to_unit_size(asset.cloud, asset.skeleton)
    subset = choose_subset(whole, 0)
    cloud = subset.cloud
    cameras = paper_views(*percentile_bounds(cloud.means), size)
    masks = np.stack([render_cloud(cloud, camera)[1] > 0.5 for camera in cameras])
    initial = initial_weights("visibility", cloud, skeleton, masks, cameras)
    signals = make_signals(skeleton, cameras[:views], poses, np.random.default_rng(0))
    images = Oracle(GuidanceContext(cloud, skeleton, initial, initial), asset.weights[subset.index]).images(signals)
    targets = [Target(s.camera, s.transforms, image) for s, image in zip(signals, images, strict=True)]
    field = create_field("pyramid", cloud.means, initial)
    preset = Preset("", poses, ((size, 10_000),), batch)
    return Optimiser(cloud, skeleton, field, targets, preset, options=LearningOptions(rasterizer="cpu"))


def iteration_cost(optimiser: Optimiser, repeats: int) -> tuple[float, float, float]:
    """Wall and core milliseconds for each render of a whole iteration, its share in looking at what the views see
    included, and the core milliseconds of that share."""
    batch, images = optimiser.preset.batch, len(optimiser.targets)
    updates = sorted(visibility_schedule(optimiser.preset, images))
    share = batch * (updates[1] - updates[0])  # renders between updates
    update = measure(lambda k: optimiser.update_visible(), repeats) if optimiser.visibility_updates else (0.0, 0.0)
    for _ in range(2):
        optimiser.step()
    step = measure(lambda k: optimiser.step(), max(6, 2 * repeats))
    wall, core = (mine / batch + looking / share for mine, looking in zip(step, update, strict=True))
    return wall, core, update[1] / share


def iteration_bars(repeats: int) -> Iterator[Bar]:
    """A full iteration of `standard`'s last stage."""
    wall, core, update = iteration_cost(make_optimiser(SPLATS, BONES, SIZE, BATCH), repeats)
    yield Bar("iteration_wall_ms_per_render", wall, None)
    yield Bar("iteration_core_ms_per_render", core, 60)
    yield Bar("looking_core_ms_per_render", update, None)


def _jobs(preset: str, repeats: int, splats: int = SPLATS, bones: int = BONES) -> list[Cost]:
    asset = figure(splats, bones)
    # The first one may compile kernels; it does not count.
    settings = {"guidance": "elastic", "rasterizer": "cpu"}
    run_job(figure(500, bones), {**settings, "preset": "draft"})
    return [run_job(asset, {**settings, "preset": preset}) for _ in range(repeats)]


def _middle(costs: list[Cost], number: Callable[[Cost], float]) -> float:
    return float(np.median([number(cost) for cost in costs]))


def standard_bars(repeats: int) -> Iterator[Bar]:
    """The preset `standard` as a job of its own."""
    costs = _jobs("standard", repeats)
    core = _middle(costs, lambda c: c.core)
    yield Bar("standard_seconds", _middle(costs, lambda c: c.without_guidance), 40, core)
    yield Bar("standard_seconds_in_all", _middle(costs, lambda c: c.wall), 180, core)
    yield Bar("standard_forecast_error", _middle(costs, Cost.forecast_error), 0.2)
    yield Bar("standard_peak_mb", _middle(costs, lambda c: c.peak_mb), 3000)


def default_bars(repeats: int) -> Iterator[Bar]:
    """The job that an artist gets who changes nothing: 50,000 splats, 30 bones."""
    asset = figure(SPLATS, 30)
    run_job(figure(500, 30), {})
    costs = [run_job(asset, {}) for _ in range(repeats)]
    yield Bar("default_seconds", _middle(costs, lambda c: c.wall), 90, _middle(costs, lambda c: c.core))
    yield Bar("default_peak_mb", _middle(costs, lambda c: c.peak_mb), None)


def thorough_bars(repeats: int) -> Iterator[Bar]:
    """The preset `thorough`: 500 iterations of 20 images at 512 px, or fewer where it sees that they are enough."""
    costs = _jobs("thorough", repeats)
    core = _middle(costs, lambda c: c.core)
    yield Bar("thorough_seconds", _middle(costs, lambda c: c.without_guidance), 360, core)
    yield Bar("thorough_iterations", _middle(costs, lambda c: c.report["iterations"]), None)
    yield Bar("thorough_forecast_error", _middle(costs, Cost.forecast_error), 0.2)


def large_bars(repeats: int) -> Iterator[Bar]:
    """500,000 splats and 60 bones."""
    costs = _jobs("draft", repeats, 500_000, 60)
    core = _middle(costs, lambda c: c.core)
    yield Bar("large_peak_mb", _middle(costs, lambda c: c.peak_mb), 4000)
    yield Bar("large_draft_seconds", _middle(costs, lambda c: c.wall), None, core)


def scene_bars(repeats: int) -> Iterator[Bar]:
    """What Blender takes; all in processor time."""
    from benchmarks import bench_scene  # bpy only where it is asked for

    imports = [bench_scene.import_seconds() for _ in range(repeats)]
    rigs = [bench_scene.rig_costs() for _ in range(repeats)]
    panels = [bench_scene.panel_seconds() for _ in range(repeats)]
    yield Bar("scene_import_seconds", median(imports), 1.0)
    yield Bar("scene_write_weights_seconds", median([rig[0] for rig in rigs]), 2.0)
    yield Bar("scene_pose_seconds", median([rig[1] for rig in rigs]), 0.06)
    yield Bar("scene_display_over_rig", median([rig[2] for rig in rigs]), 3.0)
    yield Bar("scene_check_list_ms", 1000 * median([panel[0] for panel in panels]), 10)
    yield Bar("scene_runtime_look_ms", 1000 * median([panel[1] for panel in panels]), 20)


def response_bars(repeats: int) -> Iterator[Bar]:
    """What a person waits for in the window; of the calls that must never wait, and of cancelling, the slowest."""
    yield Bar("response_read_seconds", bench_response.read_seconds(repeats), 0.8)
    answers = bench_response.cancel_jobs(repeats)
    yield Bar("response_poll_ms", 1000 * max(answers.poll), 50)
    yield Bar("response_cancel_call_ms", 1000 * max(answers.cancel), 50)
    yield Bar("response_cancelled_seconds", max(answers.end), 1.0)


def gpu_bars(repeats: int) -> Iterator[str]:
    """What `bench_gpu` prints, by the GPU's name."""
    if not cuda_device():
        for name, target in bench_gpu.SCHEDULES.items():
            yield f"gpu_{name}_seconds not run (no GPU) {target:g}"
        return
    argv, sys.argv = sys.argv, ["bench_gpu", "--runs", str(repeats)]
    try:
        bench_gpu.main()
    finally:
        sys.argv = argv


BARS: dict[str, Callable[[int], Iterator[Bar | str]]] = {
    "gradient": gradient_bars,
    "iteration": iteration_bars,
    "rasterizer": rasterizer_bars,
    "response": response_bars,
    "scene": scene_bars,
    "default": default_bars,
    "standard": standard_bars,
    "large": large_bars,
    "gpu": gpu_bars,
    "thorough": thorough_bars,
}
LONG = ("standard", "large", "thorough")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(BARS), help="groups: " + ", ".join(BARS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="without " + ", ".join(LONG))
    parser.add_argument("--write", type=Path, help="Markdown file with the markers")
    options = parser.parse_args()
    lines = [f"{thread_count()}-core CPU, medians of {options.repeats} runs", ""]
    for name in options.only.split(","):
        if options.quick and name in LONG:
            continue
        begun, threads = time.perf_counter(), torch.get_num_threads()
        for bar in BARS[name](options.repeats):
            print(bar, flush=True)
            lines.append(str(bar))
        torch.set_num_threads(threads)
        print(f"{name}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
    if options.write:
        write_between(options.write, "speed", "\n".join(["```", *lines, "```"]))


if __name__ == "__main__":
    main()
