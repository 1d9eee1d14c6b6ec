# SPDX-License-Identifier: GPL-3.0-or-later
"""The TorchScript file that `--lpips` takes: `python -m benchmarks.quality.lpips_file BACKBONE.pth OUT.pt`.

Downloads nothing. Needs the packages `lpips` (which carries its linear heads) and `torchvision` (for the layout of the
backbone), and torchvision's backbone weights as a file on disk: AlexNet (`alexnet-owt-7be5be79.pth`) for --net alex, as
the LPIPS of most papers is, or VGG-16 (`vgg16-397923af.pth`) for --net vgg.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def main() -> int:
    """Write the file; 2 where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.lpips_file", description=__doc__)
    parser.add_argument("backbone", type=Path, help="torchvision's weights, .pth")
    parser.add_argument("out", type=Path)
    parser.add_argument("--net", choices=("alex", "vgg"), default="alex")
    options = parser.parse_args()
    if not options.backbone.is_file():
        print(f"'{options.backbone}' does not exist; give torchvision's weights of the backbone.", file=sys.stderr)
        return 2
    try:
        import lpips
        import torch
    except ImportError as error:
        print(f"{error}; install lpips and torchvision beside torch.", file=sys.stderr)
        return 2
    network = lpips.LPIPS(net=options.net, pnet_rand=True, verbose=False)  # random, so that nothing is fetched
    state = torch.load(options.backbone, map_location="cpu", weights_only=True)
    try:
        load_backbone(network, state)
    except ValueError as error:
        print(f"'{options.backbone}' is no backbone '{options.net}': {error}; give torchvision's.", file=sys.stderr)
        return 2
    network.eval()
    with torch.no_grad():
        traced = torch.jit.trace(network, (torch.rand(1, 3, 512, 512), torch.rand(1, 3, 512, 512)))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    traced.save(str(options.out))
    print(f"'{options.out}' written.")
    return 0


def load_backbone(network: Any, state: Mapping[str, Any]) -> None:
    """Copy torchvision's `features.<i>.<name>` into the network's `net.slice<s>.<i>.<name>`.

    Raises:
        ValueError: a layer is missing or has another shape.
    """
    import torch

    with torch.no_grad():
        for name, value in network.net.state_dict(keep_vars=True).items():
            key = "features." + name.partition(".")[2]
            if key not in state:
                raise ValueError(f"it lacks {key}")
            if state[key].shape != value.shape:
                raise ValueError(f"{key} has the shape {tuple(state[key].shape)}, not {tuple(value.shape)}")
            value.copy_(state[key])


if __name__ == "__main__":
    sys.exit(main())
