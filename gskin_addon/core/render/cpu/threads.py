# SPDX-License-Identifier: GPL-3.0-or-later
"""A small thread pool for kernels that release the interpreter lock and share nothing.

numba's and torch's OpenMP pools, which fight each other for the cores, are not involved.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from ...ticks import cores


def thread_count() -> int:
    """Threads to use: NUMBA_NUM_THREADS if set, else the cores this process may run on."""
    asked = os.environ.get("NUMBA_NUM_THREADS", "")
    if asked.isdigit() and int(asked) > 0:
        return int(asked)
    return cores()


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_count(), thread_name_prefix="gskin-render")


def run_tasks(tasks: Sequence[Callable[[], None]]) -> None:
    """Run the tasks, in the pool when there is more than one; the first error is raised. Not from within a task."""
    if len(tasks) == 1:
        tasks[0]()
    else:
        for future in [_pool().submit(task) for task in tasks]:
            future.result()


def parallel_for(kernel: Callable[..., None], ranges: Sequence[tuple[int, int]], *args: Any) -> None:
    """Run kernel(lo, hi, *args) for every range (lo, hi)."""
    run_tasks([partial(kernel, lo, hi, *args) for lo, hi in ranges])


def row_ranges(count: int, parts: int | None = None) -> list[tuple[int, int]]:
    """[0, count) in about equal ranges, one for each thread unless `parts` says otherwise."""
    cuts = np.linspace(0, count, max(thread_count() if parts is None else parts, 1) + 1).astype(int)
    return [(int(a), int(b)) for a, b in pairwise(cuts) if b > a]
