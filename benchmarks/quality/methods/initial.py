# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial weights as a job makes them, without anything after."""

from __future__ import annotations

from gskin_addon.core.skinning.initial import initial_weights

from .base import Method, MethodInput, MethodResult

NAMES = {"initial": "visibility", "geodesic": "geodesic", "heat_splats": "heat"}


def create(name: str) -> Method:
    """`initial` is the paper's formula, `geodesic` the one through the body, `heat_splats` bone heat."""

    def make(subject: MethodInput) -> MethodResult:
        cloud, skeleton = subject.cloud, subject.skeleton
        return MethodResult(initial_weights(NAMES[name], cloud, skeleton, subject.masks, subject.cameras))

    return Method(make)
