# SPDX-License-Identifier: GPL-3.0-or-later
"""How time and memory grow with splats, bones, image size and views, and where the time goes; with plots.

    python -m benchmarks.bench_scaling [--small] [--plots docs/images] [--write docs/benchmarks.md]

An iteration is measured as in `bench_speed` (pruning included, 4 images); memory and stages come from whole `draft`
jobs in the worker's own process. `--write` puts the tables between `<!-- scaling:begin -->` and
`<!-- scaling:end -->`. About ten minutes on two free cores; `--small` is a short look at whether it works.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np

from benchmarks.bench_speed import iteration_cost, make_optimiser
from benchmarks.figure import figure
from benchmarks.jobs import Cost, run_job
from benchmarks.markers import write_between
from gskin_addon.core.render.cpu.threads import thread_count
from gskin_addon.core.skinning import optimise, pose_kernels, subset, views
from gskin_addon.core.skinning.fields.base import WeightField

BASE = {"splats": 50_000, "bones": 20, "size": 512, "views": 4}
RANGES: dict[str, tuple[int, ...]] = {
    "splats": (10_000, 50_000, 150_000, 500_000, 1_000_000),
    "bones": (5, 20, 60, 120),
    "size": (128, 256, 512, 1024),
    "views": (1, 2, 4),
}
SMALL: dict[str, tuple[int, ...]] = {"splats": (5_000, 20_000), "bones": (5, 20), "size": (128, 256), "views": (1, 4)}
JOBS = {"splats": (10_000, 50_000, 150_000, 500_000, 1_000_000), "bones": (5, 60, 120)}
SMALL_JOBS = {"splats": (5_000, 20_000), "bones": (5, 20)}
BATCH, POSES = 4, 6
COLORS = ("#1f6f8b", "#58a4b0", "#a9bcd0", "#e07a3f", "#8c5e58")
WORDS = {"splats": "splats", "bones": "bones", "size": "image size (px)", "views": "views"}


@dataclass(frozen=True)
class Point:
    """One measure: what was varied, to what; wall and core ms for a render of an iteration."""

    kind: str
    value: int
    wall: float
    core: float

SETTINGS = {"preset": "draft", "guidance": "elastic", "rasterizer": "cpu"}


def iterations(ranges: dict[str, tuple[int, ...]], base: dict[str, int]) -> Iterator[Point]:
    """Iterations with one thing varied at a time. Above the subset's limit only the subset is learned on."""
    for kind, values in ranges.items():
        for value in values:
            at = {**base, kind: value}
            if at["splats"] > subset.LIMIT:
                continue
            optimiser = make_optimiser(at["splats"], at["bones"], at["size"], BATCH, POSES, at["views"])
            wall, core, _ = iteration_cost(optimiser, 3)
            yield Point(kind, value, wall, core)


def jobs(ranges: dict[str, tuple[int, ...]], base: dict[str, int]) -> Iterator[tuple[str, int, Cost]]:
    """Whole `draft` jobs."""
    run_job(figure(500, 20), SETTINGS)  # compiles
    for kind, values in ranges.items():
        for value in values:
            at = {**base, kind: value}
            yield kind, value, run_job(figure(at["splats"], at["bones"]), SETTINGS)


def profile(splats: int, bones: int, size: int) -> dict[str, float]:
    """Wall milliseconds of an iteration by part: the parts are timed where they are called."""
    spent: dict[str, float] = {}
    kept = []

    def watch(owner: object, name: str, label: str) -> None:
        inner = getattr(owner, name)

        def timed(*args: object, **options: object) -> object:
            begun = time.perf_counter()
            try:
                return inner(*args, **options)
            finally:
                spent[label] = spent.get(label, 0.0) + time.perf_counter() - begun

        kept.append((owner, name, owner.__dict__[name]))
        setattr(owner, name, staticmethod(timed) if isinstance(owner.__dict__[name], staticmethod) else timed)

    optimiser = make_optimiser(splats, bones, size, BATCH, POSES)
    for _ in range(3):
        optimiser.step()
    watch(views, "_render_all", "rendering, both ways, with the image loss")
    watch(pose_kernels._Pose, "forward", "posing")
    watch(pose_kernels._Pose, "backward", "posing, backward")
    watch(optimise, "arap_loss", "ARAP")
    watch(optimise, "coupling_loss", "coupling")
    watch(WeightField, "forward", "weight field and softmax")
    count, begun = 6, time.perf_counter()
    for _ in range(count):
        optimiser.step()
    total = time.perf_counter() - begun
    for owner, name, inner in kept:
        setattr(owner, name, inner)
    parts = {label: 1e3 * seconds / count for label, seconds in spent.items()}
    parts["the rest: field backward, Adam, gathering"] = 1e3 * total / count - sum(parts.values())
    return parts


def plot(points: Sequence[Point], costs: Sequence[tuple[str, int, Cost]], folder: Path) -> None:
    """scaling_time.png: an iteration against each quantity; scaling_jobs.png: memory and stages against splats."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure_, axes = plt.subplots(1, 4, figsize=(11, 2.7), layout="constrained")
    for axis, kind in zip(axes, WORDS, strict=True):
        mine = [p for p in points if p.kind == kind]
        axis.plot([p.value for p in mine], [p.core for p in mine], "o-", color="#1f6f8b", label="core-ms")
        axis.plot([p.value for p in mine], [p.wall for p in mine], "o--", color="#e07a3f", label="wall ms")
        if kind in ("splats", "size", "bones"):
            axis.set_xscale("log")
        axis.set_xticks([p.value for p in mine], [_short(p.value) for p in mine])
        axis.minorticks_off()
        axis.set(xlabel=WORDS[kind], ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("for each render of an iteration")
    axes[0].legend(frameon=False)
    figure_.savefig(folder / "scaling_time.png", dpi=90)
    figure_, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
    mine = [(value, cost) for kind, value, cost in costs if kind == "splats"]
    names = [_short(value) for value, _ in mine]
    bottom = np.zeros(len(mine))
    for stage, color in zip(mine[0][1].report["seconds"], COLORS, strict=False):
        seconds = np.array([cost.report["seconds"][stage] for _, cost in mine])
        axes[0].bar(names, seconds, bottom=bottom, label=stage, color=color)
        bottom += seconds
    axes[0].set(xlabel="splats", ylabel="seconds of a draft job")
    axes[0].legend(frameon=False, bbox_to_anchor=(1, 1), loc="upper left")
    axes[1].plot(names, [cost.peak_mb / 1e3 for _, cost in mine], "o-", color="#1f6f8b")
    axes[1].axhline(4, color="#e07a3f", linestyle="--", linewidth=1)
    axes[1].set(xlabel="splats", ylabel="peak memory, GB", ylim=(0, None))
    axes[1].grid(alpha=0.3)
    figure_.savefig(folder / "scaling_jobs.png", dpi=90)


def tables(
    points: Sequence[Point],
    costs: Sequence[tuple[str, int, Cost]],
    parts: dict[str, float],
    where: str,
    at_rest: dict[str, int] = BASE,
) -> str:
    """Markdown of everything measured; at_rest: what the quantities are that are not varied."""
    base = ", ".join(f"{WORDS[kind]} {value:,}" for kind, value in at_rest.items())
    lines = [
        f"{thread_count()}-core CPU. One thing varied at a time from {base}; milliseconds for each render of a full "
        "iteration (rendering both ways, losses, posing, field, Adam, finding what views see), 4 images at a time.",
        "",
        "| varied | value | wall ms | core-ms |\n|---|---|---|---|",
        *(f"| {WORDS[p.kind]} | {p.value:,} | {p.wall:.1f} | {p.core:.1f} |" for p in points),
        "",
        f"![Time of an iteration]({where}/scaling_time.png)",
        "",
        f"Whole `draft` jobs with the built-in guidance; above {subset.LIMIT:,} splats on a weighted subset.",
        "",
        "| splats | bones | seconds | core-seconds | " + " | ".join(costs[0][2].report["seconds"]) + " | peak GB |",
        "|---|---|---|---|" + "---|" * (len(costs[0][2].report["seconds"]) + 1),
    ]
    for kind, value, cost in costs:
        at = {**at_rest, kind: value}
        numbers = [f"{at['splats']:,}", f"{at['bones']}", f"{cost.wall:.0f}", f"{cost.core:.0f}"]
        numbers += [f"{seconds:.1f}" for seconds in cost.report["seconds"].values()] + [f"{cost.peak_mb / 1e3:.2f}"]
        lines.append("| " + " | ".join(numbers) + " |")
    whole = sum(parts.values())
    lines += ["", f"![Stages and memory of jobs]({where}/scaling_jobs.png)", ""]
    lines += ["Where an iteration's time goes (wall):", "", "| part | ms | share |\n|---|---|---|"]
    ordered = sorted(parts.items(), key=lambda part: -part[1])
    lines += [f"| {label} | {ms:.1f} | {ms / whole:.0%} |" for label, ms in ordered]
    return "\n".join(lines)


def _short(value: int) -> str:
    return f"{value // 1_000_000}M" if value >= 1_000_000 else f"{value // 1000}k" if value >= 5000 else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="a short run with small numbers")
    parser.add_argument("--plots", type=Path, default=Path("out/scaling"), help="folder of the pictures")
    parser.add_argument("--write", type=Path, help="Markdown file with the markers")
    options = parser.parse_args()
    base = {**BASE, "splats": 20_000, "size": 256} if options.small else BASE
    points, costs = [], []
    for point in iterations(SMALL if options.small else RANGES, base):
        points.append(point)
        print(point, file=sys.stderr, flush=True)
    for kind, value, cost in jobs(SMALL_JOBS if options.small else JOBS, base):
        costs.append((kind, value, cost))
        print(kind, value, f"{cost.wall:.1f} s, {cost.peak_mb:.0f} MB", file=sys.stderr, flush=True)
    parts = profile(base["splats"], base["bones"], base["size"])
    plot(points, costs, options.plots)
    text = tables(points, costs, parts, "images", base)
    print(text)
    if options.write:
        write_between(options.write, "scaling", text)


if __name__ == "__main__":
    main()
