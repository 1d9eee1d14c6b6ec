# SPDX-License-Identifier: GPL-3.0-or-later
"""What a test needs beside Blender's own Python, said once and seen in the count of skipped tests."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

WORKER = ("torch", "numba", "scipy")
"""What the worker of a real job imports."""


def missing(*packages: str) -> str:
    """'' where all are installed, else "needs torch, numba"; imports none of them."""
    absent = [name for name in packages if find_spec(name) is None]
    return "needs " + ", ".join(absent) if absent else ""


def needs(*packages: str) -> None:
    """Skip the module that calls this at its head, before it imports what is not there."""
    if reason := missing(*packages):
        pytest.skip(reason, allow_module_level=True)


def only_with(*packages: str) -> pytest.MarkDecorator:
    """Mark one test or case as one that needs packages."""
    reason = missing(*packages)
    return pytest.mark.skipif(bool(reason), reason=reason)
