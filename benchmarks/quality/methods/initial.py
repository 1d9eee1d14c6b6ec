# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial weights as a job makes them, without anything after."""

from __future__ import annotations

from gskin_addon.core.skinning.initial import initial_weights

from .base import Made, Method, Subject

NAMES = {"initial": "visibility", "geodesic": "geodesic", "heat_splats": "heat"}


def create(name: str) -> Method:
    """`initial` is the paper's formula, `geodesic` the one through the body, `heat_splats` bone heat."""

    def make(subject: Subject) -> Made:
        cloud, skeleton = subject.cloud, subject.skeleton
        return Made(initial_weights(NAMES[name], cloud, skeleton, subject.masks, subject.cameras))

    return Method(make)
