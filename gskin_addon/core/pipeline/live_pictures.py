# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures in the folder of a running job, for whoever watches it; the finished job's take their place."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..files import disk_error, write_png
from ..job.contract import PREVIEWS

EVERY = 2.0
"""Seconds between two pictures of a kind, at least."""
SHARE = 0.05
"""Share of the time that pictures may take, at most."""


class LivePictures:
    """Writes a picture of each kind now and then, so seldom that the job does not notice."""

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        """folder: the job's."""
        self._folder, self._clock = folder / PREVIEWS, clock
        self._next: dict[str, float] = {}

    def show(self, name: str, make: Callable[[], NDArray[Any]]) -> bool:
        """Write `make()`, an (H, W, 3) image in 0..1, as the picture `name` if it is time for one; whether it was.

        Raises:
            GSkinError: the folder cannot be written.
        """
        begun = self._clock()
        if begun < self._next.get(name, begun):
            return False
        try:
            self._folder.mkdir(exist_ok=True)
            write_png(self._folder / f"{name}.png", make())
        except OSError as error:
            raise disk_error(error, self._folder) from error
        ended = self._clock()
        self._next[name] = ended + max(EVERY, (ended - begun) / SHARE)
        return True
