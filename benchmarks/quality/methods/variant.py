# SPDX-License-Identifier: GPL-3.0-or-later
"""`job:<key>=<value>,...`: the job with any settings, for ablations: `job:init=visibility,loss.arap=0,views=2`.

Keys are those of job.json; `loss.<name>` is a factor of the loss. `mesh=1` learns on the vertices of the asset's own
mesh, with the splats anchored to it, as `gskin rig --mesh` does.
"""

from __future__ import annotations

import json
from typing import Any

from .base import Method
from .job import create_job

PREFIX = "job:"


def parse(name: str) -> tuple[dict[str, Any], bool]:
    """Settings of job.json and whether to learn on the mesh.

    Raises:
        ValueError: a part without "=".
    """
    settings: dict[str, Any] = {}
    for part in filter(None, name.removeprefix(PREFIX).split(",")):
        key, equals, text = part.partition("=")
        if not equals:
            raise ValueError(f"'{name}' is not 'job:<key>=<value>,...'.")
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = text
        if key.startswith("loss."):
            settings.setdefault("losses", {})[key.removeprefix("loss.")] = value
        else:
            settings[key] = value
    return settings, bool(settings.pop("mesh", False))


def create(name: str) -> Method:
    """The method."""
    settings, on_mesh = parse(name)
    return create_job(settings, on_mesh=on_mesh)
