# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost of the weight fields: one forward + backward + Adam step, beside their straightforward versions.

    python benchmarks/bench_fields.py [--splats 50000] [--dense]

The splats lie on an ellipsoid shell. `torch csr` is torch's sparse CSR product on the pyramid's own matrix;
`--dense` also runs the volume's decoder as torch's dense ConvTranspose3d (3 GB, 10 s a step).
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from scipy import sparse

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gskin_addon.core.skinning.fields import create_field
from gskin_addon.core.skinning.fields.pyramid import PYRAMID
from gskin_addon.core.skinning.fields.sparse import SparseProduct, trilinear_matrix, unit_cube
from gskin_addon.core.skinning.fields.volume import decoder_widths


def shell(count: int) -> np.ndarray:
    """(N, 3) centres on an ellipsoid shell about as tall as a person."""
    direction = np.random.default_rng(0).normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * (0.45, 0.3, 0.9)


def measure(task: Callable[[], object], repeats: int) -> str:
    """Median wall ms and core-ms."""
    task()
    wall, core = [], []
    for _ in range(repeats):
        w, c = time.perf_counter(), time.process_time()
        task()
        wall.append(time.perf_counter() - w)
        core.append(time.process_time() - c)
    return f"{1e3 * np.median(wall):9.1f} {1e3 * np.median(core):9.1f}"


def product(matrix: sparse.csr_matrix, bones: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """matrix @ theta and its backward pass by torch's CSR, and by SparseProduct."""
    theta = torch.randn(matrix.shape[1], bones, requires_grad=True)
    pull = torch.randn(matrix.shape[0], bones)

    def csr(m: sparse.csr_matrix) -> torch.Tensor:
        index, pointer = (torch.from_numpy(a.astype(np.int64)) for a in (m.indices, m.indptr))
        return torch.sparse_csr_tensor(pointer, index, torch.from_numpy(m.data.astype(np.float32)), size=m.shape)

    there, back = csr(matrix), csr(matrix.T.tocsr())
    bags = SparseProduct(matrix)
    return lambda: (there @ theta.detach(), back @ pull), lambda: bags(theta).backward(pull)


def step(field: torch.nn.Module, splats: int, bones: int) -> Callable[[], object]:
    """One iteration of an optimiser that has nothing else to do."""
    adam = torch.optim.Adam(field.parameters(), lr=1e-3, fused=True)
    target = torch.rand(splats, bones)

    def run() -> None:
        adam.zero_grad()
        (field() - target).square().sum().backward()
        adam.step()

    return run


class DenseDecoder(torch.nn.Module):
    """HumanNeRF's decoder and grid_sample, as torch has them."""

    def __init__(self, points: np.ndarray, bones: int, resolution: int) -> None:
        super().__init__()
        widths = [1024, *decoder_widths(resolution), bones]
        layers: list[torch.nn.Module] = []
        for inputs, outputs in pairwise(widths):
            layers += [torch.nn.ConvTranspose3d(inputs, outputs, 4, 2, 1), torch.nn.LeakyReLU(0.2)]
        self._convolve = torch.nn.Sequential(*layers[:-1])
        self._expand = torch.nn.Sequential(torch.nn.Linear(256, 1024), torch.nn.LeakyReLU(0.2))
        self._latent = torch.nn.Parameter(torch.randn(256))
        unit = unit_cube(points)[:, ::-1] * 2 - 1
        self._at = torch.from_numpy(np.ascontiguousarray(unit, np.float32))[None, None, None]

    def forward(self) -> torch.Tensor:
        volume = self._convolve(self._expand(self._latent).view(1, -1, 1, 1, 1))
        logits = torch.nn.functional.grid_sample(volume, self._at, align_corners=True)
        return torch.softmax(logits[0, :, 0, 0].T, dim=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splats", type=int, default=50_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--dense", action="store_true")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", "Sparse")
    points = shell(options.splats)
    unit = unit_cube(points)
    matrix = sparse.hstack([trilinear_matrix(unit, size)[0] for size in PYRAMID], format="csr")
    print(f"{options.splats} splats, {matrix.shape[1]} grid corners, {torch.get_num_threads()} threads")
    print(f"{'':40} {'wall ms':>9} {'core-ms':>9}")
    for bones in (20, 60):
        plain, bags = product(matrix, bones)
        print(f"{f'{bones} bones: product, torch csr':40} {measure(plain, options.repeats)}")
        print(f"{f'{bones} bones: product, gskin':40} {measure(bags, options.repeats)}")
        initial = np.full((options.splats, bones), 1 / bones)
        for name in ("pyramid", "volume"):
            task = step(create_field(name, points, initial), options.splats, bones)
            print(f"{f'{bones} bones: {name}, whole step':40} {measure(task, options.repeats)}", flush=True)
        if options.dense:
            task = step(DenseDecoder(points, bones, 128), options.splats, bones)
            print(f"{f'{bones} bones: volume, dense':40} {measure(task, 1)}", flush=True)


if __name__ == "__main__":
    main()
