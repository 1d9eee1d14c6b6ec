# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS (Zhang et al. 2018), where its weights are on disk: a TorchScript file, never a download.

Made by `lpips_file.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


class Perceptual:
    """The distance of two pictures by the network in the TorchScript file `path`: two (1, 3, H, W) in [-1, 1] ->
    one number."""

    def __init__(self, path: Path) -> None:
        import torch

        self._torch = torch
        self._network = torch.jit.load(str(path), map_location="cpu").eval()

    def __call__(self, image: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
        """The distance of pictures (H, W, 3) in [0, 1]."""
        torch = self._torch
        with torch.no_grad():
            a, b = (torch.from_numpy(np.ascontiguousarray(x)).permute(2, 0, 1)[None] * 2 - 1 for x in (image, truth))
            return float(self._network(a, b))
