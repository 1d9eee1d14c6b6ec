# SPDX-License-Identifier: GPL-3.0-or-later
"""The up axis of splats as their file's header, or the cameras saved beside it, say it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

_WORDS = r"(?:vertical[ _-]?axis|up[ _-]?axis|world[ _-]?up|up[ _-]?(?:vector|direction))\b\s*[:=]?|up\s*[:=]"
_SAID = re.compile(rf"\b(?:{_WORDS})\s*(?P<axis>[+-]?\s*[xyz]\b|[-+\d.eE]+[ ,]+[-+\d.eE]+[ ,]+[-+\d.eE]+)", re.I)
"""Nerfstudio writes "Vertical Axis: z", Brush "Vertical axis: y", others "up_axis = -y" or "world_up 0 -1 0"."""
_SHORT = re.compile(r"(?<![\w.])(?P<axis>[+-]?[xyz])[ _-]?(?:is[ _-]?)?up\b", re.I)
"""As "Z-up", "y up"."""

_CAMERAS = "cameras.json"
_MOST = 20_000
_BYTES = 64 << 20
_ALIGNED, _AGREE = 0.9, 0.5
"""Cosine of the mean up direction of the cameras to an axis; length of that mean, 1 where all agree."""


def up_in_comments(comments: Iterable[str]) -> str:
    """The axis of `UP_AXES` that header comments name; "" where none is named, or another one."""
    for comment in comments:
        found = _SAID.search(comment) or _SHORT.search(comment)
        axis = _axis(found.group("axis")) if found else ""
        if axis:
            return axis
    return ""


def up_of_cameras(path: Path) -> str:
    """The axis of `UP_AXES` that is up for the cameras of a capture, "" where there are none or they do not agree.

    Training programs after INRIA's keep `cameras.json` (camera-to-world rotations, y down in the image) two folders
    above `point_cloud/iteration_N/point_cloud.ply`, others beside the file.
    """
    for folder in (path.parent, *path.absolute().parents[1:3]):
        try:
            file = folder / _CAMERAS
            if not file.is_file() or file.stat().st_size > _BYTES:
                continue
            down = [np.array(camera["rotation"], np.float64)[:, 1] for camera in json.loads(file.read_text())[:_MOST]]
            up = -np.mean(down, axis=0)
        except (OSError, ValueError, TypeError, KeyError, IndexError):
            continue  # somebody else's file of that name
        length = float(np.linalg.norm(up))
        if up.shape == (3,) and length > _AGREE and np.abs(up).max() > _ALIGNED * length:
            return _axis(" ".join(str(value) for value in up))
    return ""


def _axis(text: str) -> str:
    """"+Y" as "y", "0 -1 0" as "-y"; "" for what is none of `UP_AXES`."""
    numbers = re.split(r"[ ,]+", text.strip())
    if len(numbers) == 3:
        try:
            values = np.array([float(number) for number in numbers])
        except ValueError:
            return ""
        if not np.isfinite(values).all() or not values.any():
            return ""
        k = int(np.abs(values).argmax())
        name = ("-" if values[k] < 0 else "") + "xyz"[k]
    else:
        name = re.sub(r"[\s+]", "", text).lower()
    return name if name in ("z", "y", "-y") else ""
