# SPDX-License-Identifier: GPL-3.0-or-later
"""The TorchScript file that `--lpips` takes: `python -m benchmarks.quality.lpips_file BACKBONE.pth OUT.pt`.

LPIPS (Zhang et al. 2018, Eq. 1) with AlexNet, version 0.1. Downloads nothing: the linear heads come with the package
`lpips` (only its file is read, so it may be installed without what it depends on), the backbone is torchvision's
`alexnet-owt-7be5be79.pth` on your disk.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

LAYERS = ((0, 3, 64, 11, 4, 2), (3, 64, 192, 5, 1, 2), (6, 192, 384, 3, 1, 1), (8, 384, 256, 3, 1, 1),
          (10, 256, 256, 3, 1, 1))  # fmt: skip
"""AlexNet's convolutions: number among torchvision's `features`, channels in and out, kernel, stride, padding."""

POOLED = (3, 6)
"""Convolutions that a max-pooling (3, stride 2) goes before."""


class Lpips(nn.Module):
    """The distance of two images (1, 3, H, W) in [-1, 1]; H and W at least 35.

    backbone: torchvision's state of AlexNet; heads: `lin<k>.model.1.weight` (1, C, 1, 1).

    Raises:
        ValueError: a layer is missing or has another shape.
    """

    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, backbone: Mapping[str, Any], heads: Mapping[str, Any]) -> None:
        super().__init__()
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[None, :, None, None])
        self.stages, self.heads = nn.ModuleList(), nn.ParameterList()
        for number, (place, inside, outside, kernel, stride, padding) in enumerate(LAYERS):
            layer = nn.Conv2d(inside, outside, kernel, stride, padding)
            with torch.no_grad():
                layer.weight.copy_(_layer(backbone, f"features.{place}.weight", layer.weight.shape))
                assert layer.bias is not None
                layer.bias.copy_(_layer(backbone, f"features.{place}.bias", layer.bias.shape))
            pool = [nn.MaxPool2d(3, 2)] if place in POOLED else []
            self.stages.append(nn.Sequential(*pool, layer, nn.ReLU()))
            self.heads.append(_layer(heads, f"lin{number}.model.1.weight", (1, outside, 1, 1)))

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """(1, 1, 1, 1)."""
        first, second = ((image - self.shift) / self.scale for image in (first, second))
        total = torch.zeros((1, 1, 1, 1))
        for stage, head in zip(self.stages, self.heads, strict=True):
            first, second = stage(first), stage(second)
            units = [each / (each.square().sum(1, keepdim=True).sqrt() + 1e-10) for each in (first, second)]
            gap = (units[0] - units[1]).square()
            total = total + (gap * head).sum(1, keepdim=True).mean((2, 3), keepdim=True)
        return total


def main() -> int:
    """Write the file; 2 where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.lpips_file", description=__doc__)
    parser.add_argument("backbone", type=Path, help="torchvision's weights of AlexNet, .pth")
    parser.add_argument("out", type=Path)
    parser.add_argument("--heads", type=Path, help="weights/v0.1/alex.pth of lpips; default that of the installed one")
    options = parser.parse_args()
    heads = options.heads or installed_heads()
    for path, remedy in ((options.backbone, "give torchvision's AlexNet"), (heads, "install lpips, or give --heads")):
        if path is None or not path.is_file():
            print(f"'{path or 'lpips/weights/v0.1/alex.pth'}' is not here; {remedy}.", file=sys.stderr)
            return 2
    read = [torch.load(path, map_location="cpu", weights_only=True) for path in (options.backbone, heads)]
    try:
        network = Lpips(*read).eval()
    except ValueError as error:
        print(f"'{options.backbone}' and '{heads}' are not AlexNet and its heads: {error}.", file=sys.stderr)
        return 2
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write(network, options.out)
    print(f"'{options.out}' written.")
    return 0


def installed_heads() -> Path | None:
    """The heads' file of the installed package `lpips`, which is not imported; None without it."""
    found = importlib.util.find_spec("lpips")
    places: Sequence[str] = [] if found is None else found.submodule_search_locations or []
    return Path(places[0]) / "weights" / "v0.1" / "alex.pth" if places else None


def write(network: Lpips, path: Path) -> None:
    """As TorchScript, for images of any size."""
    images = torch.rand(1, 3, 96, 96), torch.rand(1, 3, 96, 96)
    with torch.no_grad():
        torch.jit.trace(network, images).save(str(path))


def _layer(state: Mapping[str, Any], name: str, shape: Sequence[int]) -> torch.Tensor:
    if name not in state:
        raise ValueError(f"there is no {name}")
    if tuple(state[name].shape) != tuple(shape):
        raise ValueError(f"{name} has the shape {tuple(state[name].shape)}, not {tuple(shape)}")
    tensor: torch.Tensor = state[name].detach().float()
    return tensor


if __name__ == "__main__":
    sys.exit(main())
