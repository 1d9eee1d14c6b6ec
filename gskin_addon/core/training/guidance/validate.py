# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity of generated to true images (the paper's Table IV): PSNR, SSIM, LPIPS where it is on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import InputError
from ...guidance.control import ControlSignal
from ...guidance.diffusion import Frame, Painter, composite, image_seed
from ...guidance.provider import to_bytes
from ...render.camera import look_at
from ...render.image_metrics import psnr, ssim
from .pairs import Pair, PairDataset

BEST_PSNR = 60.0
"""dB that count for an image without any error."""


def chosen_pairs(count: int, most: int) -> list[int]:
    """Numbers of at most `most` of `count` pairs, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def validate(
    painter: Painter,
    pairs: PairDataset,
    most: int,
    seed: int,
    tell: Callable[[float], None],
    lpips: Callable[[NDArray[Any], NDArray[Any]], float] | None = None,
) -> dict[str, float]:
    """Means over at most `most` pairs of the generated images against the posed ones.

    Composited outside the mask, as guidance uses them, and raw, as the model paints them: what it does to the still
    part of a picture shows there only. The paper does not say which its Table IV has.

    Returns:
        pairs: how many; psnr in dB, ssim, and lpips where it was given, of the composited images; raw_psnr, raw_ssim,
        raw_lpips: of the raw ones.
    """
    scores: dict[str, list[float]] = {}
    numbers = chosen_pairs(len(pairs), most)
    for group in _groups(pairs, numbers, painter.batch):
        frames = [_frame(pairs[number], place, image_seed(seed, number)) for number, place in group]
        begun, share = len(scores.get("psnr", ())) / len(numbers), len(group) / len(numbers)

        def tick(part: float, begun: float = begun, share: float = share) -> None:
            tell(begun + part * share)

        images = painter.paint(frames, tick)
        for (number, _), frame, image in zip(group, frames, images, strict=True):
            truth = pairs[number].posed.astype(np.float32) / 255
            raw = np.asarray(image)
            raw = raw if raw.dtype == np.uint8 else to_bytes(raw)
            for kind, pixels in (("", composite(frame, image)), ("raw_", raw)):
                made = pixels.astype(np.float32) / 255
                scores.setdefault(f"{kind}psnr", []).append(min(psnr(made, truth), BEST_PSNR))
                scores.setdefault(f"{kind}ssim", []).append(ssim(made, truth))
                if lpips is not None:
                    scores.setdefault(f"{kind}lpips", []).append(lpips(made, truth))
    return {"pairs": len(numbers), **{name: round(float(np.mean(values)), 4) for name, values in scores.items()}}


def _groups(pairs: PairDataset, numbers: list[int], most: int) -> Iterator[list[tuple[int, int]]]:
    """Runs of pairs with the same rest image, with the number of that image."""
    places: dict[tuple[str, int], int] = {}
    group: list[tuple[int, int]] = []
    for number in numbers:
        pair = pairs[number]
        place = places.setdefault((pair.asset, pair.view), len(places))
        if group and (group[-1][1] != place or len(group) == most):
            yield group
            group = []
        group.append((number, place))
    if group:
        yield group


def _frame(pair: Pair, place: int, seed: int) -> Frame:
    """A painter reads the control points and the view's number of a signal, not its camera and pose."""
    height, width = pair.mask.shape
    camera = look_at((0, -1, 0), (0, 0, 0), size=(height, width))
    signal = ControlSignal(
        place, camera, np.zeros((0, 4, 4)), pair.handles.astype(np.float64), pair.targets.astype(np.float64)
    )
    rest = pair.rest.astype(np.float32) / 255
    return Frame(signal, rest, rest, pair.mask, seed, pair.bones)


def load_lpips(path: str) -> Callable[[NDArray[Any], NDArray[Any]], float]:
    """LPIPS (Zhang et al. 2018) from a TorchScript file: two (1, 3, H, W) in [-1, 1] -> their distance.

    Raises:
        InputError: it is not such a file.
    """
    try:
        load: Any = torch.jit.load
        network = load(str(Path(path).expanduser()), map_location="cpu").eval()
    except (OSError, RuntimeError, ValueError) as error:
        line = str(error).strip().split("\n")[0]
        raise InputError(f"'{path}' does not hold LPIPS as TorchScript ({line}); see docs/guidance.md.") from None

    def distance(image: NDArray[Any], truth: NDArray[Any]) -> float:
        a, b = (torch.from_numpy(np.ascontiguousarray(x, np.float32)).permute(2, 0, 1)[None] for x in (image, truth))
        with torch.no_grad():
            return float(network(a * 2 - 1, b * 2 - 1))

    return distance
