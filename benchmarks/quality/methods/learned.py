# SPDX-License-Identifier: GPL-3.0-or-later
"""Learned initial weights, always of a model that has not seen the family of the asset at hand."""

from __future__ import annotations

import os
from pathlib import Path

from benchmarks.quality.catalog import family_of
from gskin_addon.core.skinning.initial import initial_weights
from gskin_addon.core.skinning.learned.model_file import SHIPPED, models_without, read_card

from .base import Method, MethodInput, MethodResult, Unavailable

FOLDS = Path(os.environ.get("GSKIN_PRIOR_FOLDS", "out/prior-folds"))
"""Folder of models (`gskin train-prior`), each of which names the families that it has not seen."""


def unseen_model(asset: str) -> Path:
    """The model for an asset: the shipped one, where it never saw the asset's family.

    Raises:
        Unavailable: no model has left out the asset's family.
    """
    family = family_of(asset)
    path = SHIPPED if family in read_card(SHIPPED).left_out else models_without(family, FOLDS)
    if path is None:
        raise Unavailable(f"no model in '{FOLDS}' leaves out the family '{family}'")
    return path.resolve()


def create(name: str) -> Method:
    """The method."""

    def make(subject: MethodInput) -> MethodResult:
        model = unseen_model(subject.asset.name)
        options = {"model": str(model)}
        weights = initial_weights(
            "learned", subject.cloud, subject.skeleton, subject.masks, subject.cameras, options
        )
        return MethodResult(weights, f"model {model.stem}")

    return Method(make)
