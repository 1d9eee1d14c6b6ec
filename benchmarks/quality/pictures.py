# SPDX-License-Identifier: GPL-3.0-or-later
"""Contact sheets of the best and the worst cases, as JPEG small enough for the documentation."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from benchmarks.assets import load_asset
from gskin_addon.core.render.rasterizer import render_cloud

from .judge import Judge
from .protocol import Protocol
from .results import load_weights, weights_path
from .summary import BASE, MESH, Summary

TILE = 288
MOST_BYTES = 300_000


def make_sheets(
    summary: Summary, protocol: Protocol, folder: Path, out: Path, method: str, count: int = 4
) -> list[tuple[str, str]]:
    """quality_best.jpg and quality_worst.jpg in `out`: (file name, caption), for those that can be made.

    Rows: the assets on which `method` is best and worst against the initial weights; columns: rest, truth, initial
    weights, bone heat on the true mesh, the method, in the frame in which the initial weights err most.
    """
    shown = [BASE, MESH, method]
    cases = [
        r for r in summary.of(method)
        if all(weights_path(folder, r.asset, m, protocol.key).is_file() for m in shown)
    ]  # fmt: skip
    initial = {r.asset: r.score["error"] or 0.0 for r in summary.of(BASE)}
    cases = [r for r in cases if initial.get(r.asset, 0.0) > 0.02]  # of the rest there is nothing to see
    cases.sort(key=lambda r: ((r.score["error"] or 0.0) / initial[r.asset], r.asset))
    made = []
    for name, chosen in (("best", cases[:count]), ("worst", cases[::-1][:count])):
        if not chosen:
            continue
        names = [r.asset for r in chosen]
        rows = [_row(asset, protocol, folder, shown) for asset in names]
        image = _labelled(np.concatenate(rows), ["rest", "truth", *shown], names)
        save_jpeg(image, out / f"quality_{name}.jpg")
        caption = f"`{method}` at its {name} against the initial weights: {', '.join(names)}"
        made.append((f"quality_{name}.jpg", caption))
    return made


def _row(asset_name: str, protocol: Protocol, folder: Path, methods: Sequence[str]) -> NDArray[Any]:
    asset = load_asset(asset_name, protocol.splats, protocol.seed, unused_bones=protocol.unused_bones)
    small = Protocol(**{**vars(protocol), "size": TILE, "picture_frames": 1})
    judge = Judge(asset, small)
    weights = [load_weights(weights_path(folder, asset_name, m, protocol.key)) for m in methods]
    frame = int(judge.distances(weights[0]).mean(axis=1).argmax())
    truth = judge.render(asset.weights, frame)
    posed = [judge.render(w, frame) for w in weights]
    view = int(np.argmax([np.square(a - b).sum() for a, b in zip(posed[0], truth, strict=True)]))
    rest = render_cloud(asset.cloud, judge.cameras[view])[0]
    return np.concatenate([rest, truth[view], *(p[view] for p in posed)], axis=1)


def _labelled(picture: NDArray[Any], columns: Sequence[str], rows: Sequence[str]) -> Image.Image:
    image = Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for number, title in enumerate(columns):
        draw.text((number * TILE + 6, 4), title, fill=(20, 20, 20))
    for number, title in enumerate(rows):
        draw.text((6, (number + 1) * TILE - 16), title, fill=(20, 20, 20))
    return image


def save_jpeg(image: Image.Image, path: Path) -> None:
    """Write the picture with the best quality that stays under `MOST_BYTES`."""
    for quality in (92, 85, 75, 60, 45, 30):
        buffer = io.BytesIO()
        image.save(buffer, "JPEG", quality=quality, optimize=True)
        if buffer.tell() <= MOST_BYTES:
            break
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_bytes(buffer.getvalue())
    os.replace(temporary, path)
