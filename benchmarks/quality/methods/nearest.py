# SPDX-License-Identifier: GPL-3.0-or-later
"""Every splat follows its nearest bone: the least that a method must beat."""

from __future__ import annotations

from .base import Made, Method, Subject, rigid_weights


def create(name: str) -> Method:
    """The method."""

    def make(subject: Subject) -> Made:
        return Made(rigid_weights(subject.cloud.means, subject.skeleton))

    return Method(make)
