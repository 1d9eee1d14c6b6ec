# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest

from gskin_addon.core.errors import GSkinError
from gskin_addon.core.pipeline.live_pictures import EVERY, LivePictures


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_pictures_come_seldom_and_dear_ones_more_seldom(tmp_path):
    clock, made = Clock(), []
    pictures = LivePictures(tmp_path, clock)

    def draw(seconds):
        def make():
            clock.now += seconds
            made.append(seconds)
            return np.zeros((2, 2, 3))

        return make

    assert pictures.show("a", draw(0.0))
    assert not pictures.show("a", draw(0.0))
    assert pictures.show("b", draw(0.5)), "each kind has its own time"
    clock.now += EVERY
    assert pictures.show("a", draw(0.0))
    assert not pictures.show("b", draw(0.5)), "half a second of drawing waits ten"
    clock.now += 10
    assert pictures.show("b", draw(0.5))
    assert made == [0.0, 0.5, 0.0, 0.5]
    assert sorted(path.name for path in (tmp_path / "previews").iterdir()) == ["a.png", "b.png"]


def test_a_folder_that_is_gone_is_a_sentence(tmp_path):
    with pytest.raises(GSkinError, match="previews"):
        LivePictures(tmp_path / "gone").show("a", lambda: np.zeros((2, 2, 3)))
