# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the rigged assets of the benchmarks and tests are, and how they become splats with the artist's weights."""

from __future__ import annotations

import os
from pathlib import Path

from gskin_addon.core.training import rigged
from gskin_addon.core.training.rigged import RiggedSplats, Surface

__all__ = ["ASSETS", "RiggedSplats", "Surface", "load_asset"]

ASSETS = Path(os.environ.get("GSKIN_ASSETS", Path(__file__).resolve().parents[2] / "shared" / "assets"))


def load_asset(
    name: str, count: int, seed: int = 0, folder: Path = ASSETS, *, unused_bones: bool = False
) -> RiggedSplats:
    """`npz/<name>.npz` of the folder as `count` splats; see `rigged.load_asset`."""
    return rigged.load_asset(folder / "npz" / f"{name}.npz", count, seed, unused_bones=unused_bones)
