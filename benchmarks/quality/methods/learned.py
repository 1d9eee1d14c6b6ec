# SPDX-License-Identifier: GPL-3.0-or-later
"""Learned initial weights, always of a model that has not seen the family of the asset at hand.

The models are safetensors files in `FOLDS`, each of which names the families that its training left out in its
metadata (`left_out_families`, a JSON list or names separated by semicolons).
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.quality.catalog import family_of
from gskin_addon.core.skinning.initial import INITIAL_WEIGHTS, initial_weights

from .base import Made, Method, Subject, Unavailable

FOLDS = Path(os.environ.get("GSKIN_PRIOR_FOLDS", "out/prior-folds"))
MODEL_VARIABLE = "GSKIN_PRIOR_MODEL"
"""The environment variable that names the model file of the learned weights, in place of the shipped one."""


def left_out_families(path: Path) -> list[str]:
    """The families that a model's training left out, from the header of its safetensors file; empty if unnamed."""
    with path.open("rb") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        metadata = json.loads(file.read(size)).get("__metadata__", {})
    text = str(metadata.get("left_out_families", "")).strip()
    if text.startswith("["):
        return [str(name) for name in json.loads(text)]
    return [name.strip() for name in text.split(";") if name.strip()]


def fold_of(family: str, folder: Path | None = None) -> Path | None:
    """The first model in `folder` whose training left `family` out."""
    folder = folder or FOLDS
    files = sorted(folder.glob("*.safetensors")) if folder.is_dir() else []
    return next((path for path in files if family in left_out_families(path)), None)


@contextmanager
def unseen_model(asset: str | None) -> Iterator[str]:
    """Lets the learned weights use a model that has not seen the family of `asset`; gives a note that names it.

    None: nothing learned takes part. Raises Unavailable where no model leaves the family out.
    """
    if asset is None:
        yield ""
        return
    if "learned" not in INITIAL_WEIGHTS:
        raise Unavailable("this version has no init 'learned'")
    family = family_of(asset)
    path = fold_of(family)
    if path is None:
        raise Unavailable(f"no model in '{FOLDS}' leaves out the family '{family}'")
    before = os.environ.get(MODEL_VARIABLE)
    os.environ[MODEL_VARIABLE] = str(path.resolve())
    try:
        yield f"model {path.stem}"
    finally:
        if before is None:
            del os.environ[MODEL_VARIABLE]
        else:
            os.environ[MODEL_VARIABLE] = before


def create(name: str) -> Method:
    """The method.

    Raises:
        Unavailable: this version has no learned weights.
    """
    if "learned" not in INITIAL_WEIGHTS:
        raise Unavailable("this version has no init 'learned'")

    def make(subject: Subject) -> Made:
        with unseen_model(subject.asset.name) as note:
            weights = initial_weights("learned", subject.cloud, subject.skeleton, subject.masks, subject.cameras)
        return Made(weights, note)

    return Method(make)
