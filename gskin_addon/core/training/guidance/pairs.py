# SPDX-License-Identifier: GPL-3.0-or-later
"""Image pairs to fine-tune guidance models on (Sec. IV): rest image, posed image, control points, dynamic mask.

A data set is a folder:
    manifest.json      {"version", "settings", "assets": [name, family, split, licence, author], "shards": [...]};
                       lists what is finished, so a killed run goes on behind it
    shards/NAME.npz    pairs of one asset: rest_V (PNG of view V), and per pair P posed_P, mask_P (PNG), handles_P and
                       targets_P (K, 2) pixel positions (x, y); view (P,); since 0.2.0 also the skeleton of pair P,
                       bones_P (2, S, 2, 3) and bone_P (S,): `DrawnBones`, at rest and posed
Reading needs numpy and Pillow only.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files import is_plain_name, read_arrays
from ...guidance.skeleton_image import DrawnBones
from .split import TRAIN

VERSION = 1
MANIFEST, SHARDS = "manifest.json", "shards"


@dataclass(frozen=True)
class Pair:
    """rest, posed (H, W, 3) uint8 sRGB; mask (H, W) bool, where a model may paint; handles, targets (K, 2) float32
    pixel positions (x, y) of the displaced joints; asset: its name; view: index of the camera; bones: the skeleton as
    the camera sees it, None in pairs of an older gskin."""

    rest: NDArray[np.uint8]
    posed: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    handles: NDArray[np.float32]
    targets: NDArray[np.float32]
    asset: str
    view: int
    bones: DrawnBones | None = None


class PairDataset:
    """The finished pairs of one split, by number; a map-style data set for torch's DataLoader.

    Each process opens the shards for itself, one pair is read at a time.
    """

    def __init__(self, folder: Path, split: str = TRAIN) -> None:
        """split: "train" or "validation".

        Raises:
            InputError: the folder is no data set, or has no pairs of that split.
        """
        self._folder = folder
        manifest = read_manifest(folder)
        self.size = int(manifest["settings"]["size"])
        self._shards = [shard for shard in manifest["shards"] if shard["split"] == split]
        self._ends = np.cumsum([shard["pairs"] for shard in self._shards])
        if not len(self):
            raise InputError(f"'{folder}' has no finished pairs to {split} on; make them with train-guidance pairs.")

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, number: int) -> Pair:
        if not 0 <= number < len(self):
            raise IndexError(number)
        index = int(np.searchsorted(self._ends, number, side="right"))
        shard = self._shards[index]
        inside = number - (int(self._ends[index - 1]) if index else 0)
        path = self._folder / SHARDS / shard["file"]
        try:
            view = int(np.atleast_1d(read_arrays(path, ["view"])["view"])[inside])
            names = [f"rest_{view}", *(f"{what}_{inside}" for what in ("posed", "mask", "handles", "targets"))]
            arrays = read_arrays(path, names, optional := [f"bones_{inside}", f"bone_{inside}"])
            bones = _bones(*(arrays.pop(name) for name in optional)) if arrays.keys() >= set(optional) else None
            *images, handles, targets = (arrays[name] for name in names)
            rest, posed, mask = (decode_image(image) for image in images)
        except (OSError, ValueError, TypeError, IndexError, SyntaxError) as error:
            raise InputError(f"The shard '{path}' is damaged ({error}); delete it and make the pairs again.") from None
        return Pair(rest, posed, mask, handles, targets, shard["asset"], view, bones)

    def __iter__(self) -> Iterator[Pair]:
        return (self[number] for number in range(len(self)))


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a data set.

    Raises:
        InputError: there is none, or another version wrote it.
    """
    path = folder / MANIFEST
    try:
        manifest: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        version = manifest["version"]
    except FileNotFoundError:
        raise InputError(f"'{folder}' is no set of image pairs; make one with train-guidance pairs.") from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"'{path}' cannot be read ({error}); make the pairs again in another folder.") from None
    if version != VERSION:
        raise InputError(f"'{path}' has version {version}, this gskin reads {VERSION}; make the pairs again.")
    settings, shards = manifest.get("settings"), manifest.get("shards")
    sized = isinstance(settings, dict) and type(settings.get("size")) is int
    if not sized or not isinstance(shards, list) or not all(_is_shard(shard) for shard in shards):
        raise InputError(f"'{path}' is no list of image pairs; make the pairs again in another folder.")
    return manifest


def _is_shard(shard: Any) -> bool:
    return (
        isinstance(shard, dict)
        and all(isinstance(shard.get(name), str) for name in ("file", "asset", "split"))
        and type(shard.get("pairs")) is int
        and shard["pairs"] >= 0
        and is_plain_name(shard["file"])
    )


def _bones(places: NDArray[Any], bone: NDArray[Any]) -> DrawnBones:
    if places.shape != (2, len(bone), 2, 3) or not np.issubdtype(bone.dtype, np.integer):
        raise ValueError("its bones do not fit together")
    return DrawnBones(places[0], places[1], bone)


def encode_image(image: NDArray[Any]) -> NDArray[np.uint8]:
    """PNG bytes of an (H, W, 3) uint8 or (H, W) bool image."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return np.frombuffer(buffer.getvalue(), np.uint8)


def decode_image(data: NDArray[np.uint8]) -> NDArray[Any]:
    """The image of PNG bytes. Raises OSError, SyntaxError or ValueError for anything else."""
    from PIL import Image

    # PNG and nothing else: for some formats Pillow starts other programs.
    try:
        with Image.open(io.BytesIO(data.tobytes()), formats=["PNG"]) as picture:
            return np.array(picture)
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from None
