# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos for VBench (paper, Tables I and III): `python -m benchmarks.paper.videos OUT --weights NAME=FOLDER ...`.

Each asset's own animation from the front, with the weights of each folder (laid out as for `--method-weights`) and, as
`truth`, the artist's. MP4 where ffmpeg is installed, else GIF; --frames also keeps the frames as PNG. VBench itself is
not part of this project: what it needs and how it is called is printed.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.assets import load_asset
from benchmarks.quality.cases import isotropic
from benchmarks.quality.export import chosen_entries
from benchmarks.quality.judge import Judge
from benchmarks.quality.protocol import Protocol
from benchmarks.quality.submitted import read_submitted
from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.files import write_png

DIMENSIONS = ("subject_consistency", "aesthetic_quality", "imaging_quality")
"""The paper's Consis., Aes. and IQ, by VBench's names."""


def main() -> int:
    """Write the videos; 2 where assets or weights are wrong."""
    options = _parse()
    try:
        folders = _folders(options.weights)
        for entry in chosen_entries(options.assets, options.sample):
            asset = load_asset(entry.name, options.splats)
            if options.isotropic:
                asset = isotropic(asset).asset
            protocol = Protocol(splats=options.splats, frames=options.length, picture_frames=1, views=1, poses=1)
            judge = Judge(asset, replace(protocol, size=options.size))
            for name, folder in folders.items():
                weights = asset.weights if folder is None else read_submitted(folder, asset).weights
                pictures = [judge.render(weights, frame)[0] for frame in range(len(judge.frames))]
                path = write_video(options.out / name / entry.name, pictures, options.fps, options.frames)
                print(f"'{path}': {len(pictures)} frames", flush=True)
    except FileNotFoundError as error:
        print(f"{error}; add it, or choose other assets.", file=sys.stderr)
        return 2
    except GSkinError as error:
        print(error, file=sys.stderr)
        return 2
    print(needs(options.out, list(folders)))
    return 0


def write_video(stem: Path, pictures: Sequence[NDArray[Any]], fps: int, keep_frames: bool = False) -> Path:
    """`stem`.mp4 where ffmpeg is on the PATH, else `stem`.gif, of pictures (H, W, 3) in 0..1; `stem`/NNNN.png too
    where the frames are to be kept.

    Raises:
        GSkinError: ffmpeg failed, or the disk is full.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    ffmpeg = shutil.which("ffmpeg")
    with tempfile.TemporaryDirectory() as temporary:
        frames = stem if keep_frames else Path(temporary)
        if keep_frames or ffmpeg:
            frames.mkdir(exist_ok=True)
            for number, picture in enumerate(pictures):
                write_png(frames / f"{number:04d}.png", np.clip(picture, 0, 1))
        if ffmpeg:
            path = stem.with_name(stem.name + ".mp4")
            command = [ffmpeg, "-y", "-loglevel", "error", "-framerate", str(fps), "-i", str(frames / "%04d.png"),
                       "-c:v", "libx264", "-crf", "12", "-pix_fmt", "yuv420p", str(path)]  # fmt: skip
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise GSkinError(f"ffmpeg could not write '{path}' ({done.stderr.strip()[:200]}); check its codecs.")
            return path
    path = stem.with_name(stem.name + ".gif")
    images = [Image.fromarray((np.clip(p, 0, 1) * 255 + 0.5).astype(np.uint8)) for p in pictures]
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
    return path


def needs(out: Path, names: Sequence[str]) -> str:
    """How VBench is called on the folders, and what it needs that is not here."""
    lines = []
    if not shutil.which("ffmpeg"):
        lines.append("ffmpeg is not on the PATH: GIF has 256 colours, which lowers imaging quality; MP4 needs it.")
    if importlib.util.find_spec("vbench") is None:
        lines.append(
            "VBench is not installed here: `pip install vbench` into an environment of its own. On its first run it "
            "fetches DINO, CLIP with the LAION aesthetic head, and MUSIQ weights; a GPU is advised."
        )
    lines.append("Then, for each method:")
    lines += [
        f"  vbench evaluate --mode=custom_input --dimension {dimension} --videos_path {out / name}"
        for name in names
        for dimension in DIMENSIONS
    ]
    return "\n".join(lines)


def _folders(pairs: Sequence[str]) -> dict[str, Path | None]:
    found: dict[str, Path | None] = {"truth": None}
    for pair in pairs:
        name, _, folder = pair.partition("=")
        if not folder or not Path(folder).is_dir():
            raise InputError(f"'{pair}' is not NAME=FOLDER with a folder that exists; give the folder of the weights.")
        found[name] = Path(folder)
    return found


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper.videos", description=__doc__)
    add = parser.add_argument
    add("out", type=Path)
    add("--weights", action="append", default=[], metavar="NAME=FOLDER")
    add("--assets", default="", help="names, separated by commas; default all candidates")
    add("--sample", type=int, default=0, help="this many assets, balanced over categories and families")
    add("--splats", type=int, default=Protocol.splats)
    add("--isotropic", action="store_true", help="balls instead of ellipsoids")
    add("--size", type=int, default=Protocol.size, help="pixels across")
    add("--length", type=int, default=24, help="frames of a video, at most those of the animation")
    add("--fps", type=int, default=12)
    add("--frames", action="store_true", help="keep the frames as PNG")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
