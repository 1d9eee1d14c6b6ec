# SPDX-License-Identifier: GPL-3.0-or-later
"""What reading and writing each format of splats takes; prints the table of docs/formats.md.

    python -m benchmarks.bench_formats [--splats 1000000] [--degree 3] [--only spz,sog]

Each file is read in a process of its own; its memory is what the process had at most, less what it had before, and
"times the file" relates that to the file's size. Seconds are of processor time, which other programs disturb least.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.formats import FORMATS, reading
from gskin_addon.core.splats.ply import write_ply
from gskin_addon.core.splats.spz import write_spz


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--only", default="")
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read is not None:
        print(json.dumps(measure(options.read)))
        return
    cloud = made_up(options.splats, options.degree)
    print(f"{options.splats:,} splats of degree {options.degree}")
    print("| format | file, MB | write, s | read, s | longest piece, ms | memory, MB | times the file |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, (suffix, write) in writers().items():
            if options.only and name not in options.only.split(","):
                continue
            path = Path(folder) / f"a{suffix}"
            start = time.process_time()
            write(path, cloud)
            written = time.process_time() - start
            command = [sys.executable, "-m", "benchmarks.bench_formats", "--read", str(path)]
            found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            size = path.stat().st_size / 1e6
            print(
                f"| {name} | {size:.0f} | {written:.1f} | {found['seconds']:.1f} | {found['piece'] * 1e3:.0f} | "
                f"{found['memory']:.0f} | {found['memory'] / size:.1f} |",
                flush=True,
            )
            path.unlink()


def writers() -> dict:
    """Suffix and writer of each row of the table."""
    rows = {name: (form.suffixes[0], form.write) for name, form in FORMATS.items()}
    rows["ply, ascii"] = (".ply", partial(write_ply, fmt="ascii"))
    rows["spz 4"] = (".spz", partial(write_spz, version=4))
    return rows


def made_up(count: int, degree: int) -> SplatCloud:
    """Splats on a lumpy surface, along a curve through it, as noisy as captures are."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    quats = rng.normal(size=(count, 4))
    sh = 0.1 * rng.normal(size=(count, (degree + 1) ** 2, 3))
    sh[:, 0] *= 10.0
    return SplatCloud(
        means=directions * (1.0 + 0.2 * np.sin(5.0 * directions[:, :1]) + 0.01 * rng.normal(size=(count, 1))),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-5.5, 0.7, size=(count, 3))),
        opacities=rng.beta(2.0, 1.0, count),
        sh=sh,
    )


def measure(path: Path) -> dict[str, float]:
    """Processor seconds, seconds of the longest piece, and MB that reading the file takes, in this process."""
    list(reading_of_a_few(path))  # imports and first uses
    before = peak_memory()
    start = time.process_time()
    longest = 0.0
    steps = reading(path)
    while True:
        begun = time.process_time()
        try:
            next(steps)
        except StopIteration:
            break
        finally:
            longest = max(longest, time.process_time() - begun)
    seconds = time.process_time() - start
    return {"seconds": seconds, "piece": longest, "memory": peak_memory() - before}


def peak_memory() -> float:
    """MB that this process has had at most; Linux, where `getrusage` also counts who started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e6


def reading_of_a_few(path: Path):
    """One splat in the same format, read to its end."""
    cloud = made_up(1, 1)
    with tempfile.TemporaryDirectory() as folder:
        few = Path(folder) / path.name
        next(write for suffix, write in writers().values() if path.name.endswith(suffix))(few, cloud)
        yield from reading(few)


if __name__ == "__main__":
    main()
