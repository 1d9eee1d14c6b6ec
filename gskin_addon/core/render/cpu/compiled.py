# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a kernel is in the user's cache, or a first picture has to wait for numba."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def is_compiled(kernel: Any) -> bool:
    """Whether numba has kept the compiled kernel, for this Python at least; one of older source counts, too."""
    cache = kernel.stats.cache_path
    return bool(cache) and any(Path(cache).glob(f"*{kernel.py_func.__name__}-*.nbi"))
