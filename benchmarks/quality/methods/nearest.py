# SPDX-License-Identifier: GPL-3.0-or-later
"""Every splat follows its nearest bone: the least that a method must beat."""

from __future__ import annotations

from .base import Method, MethodInput, MethodResult, rigid_weights


def create(name: str) -> Method:
    """The method."""

    def make(subject: MethodInput) -> MethodResult:
        return MethodResult(rigid_weights(subject.cloud.means, subject.skeleton))

    return Method(make)
