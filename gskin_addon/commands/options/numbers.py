# SPDX-License-Identifier: GPL-3.0-or-later
"""What turns the text of an option into a number, and refuses what is out of range."""

from __future__ import annotations

import argparse

AUTO_SCALE = "auto"
LAST_FRAME = 1048574
"""Blender's."""


def positive(text: str) -> int:
    """A whole number of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


def count(text: str) -> int:
    """A whole number of at least 0."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is not at least 0")
    return value


def length(text: str) -> float:
    """A length in metres, at least 0."""
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{value} is not a length")
    return value


def size(text: str) -> int:
    """The side of an image in pixels: a multiple of 64."""
    value = int(text)
    if value < 64 or value % 64:
        raise argparse.ArgumentTypeError(f"{value} is not a multiple of 64")
    return value


def aspect(text: str) -> float:
    """A ratio of at least 1."""
    value = float(text)
    if not 1.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


def scale(text: str) -> float | str:
    """A factor above 0, or AUTO_SCALE."""
    if text == AUTO_SCALE:
        return text
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{value} is not above 0")
    return value


def seed(text: str) -> int:
    """A whole number of 32 bits."""
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{value} is not in 0..4294967295")
    return value


def unit(text: str) -> float:
    """A number in 0..1."""
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{value} is not in 0..1")
    return value


def frame(text: str) -> float:
    """A frame that Blender has, or a place between two."""
    value = float(text)
    if not -LAST_FRAME <= value <= LAST_FRAME:
        raise argparse.ArgumentTypeError(f"{text} is not in -{LAST_FRAME}..{LAST_FRAME}")
    return value


# argparse names the converter in its message
positive.__name__, seed.__name__, unit.__name__ = "whole number", "whole number", "number"
count.__name__ = "whole number"
scale.__name__, frame.__name__ = "auto, or number", "number"
size.__name__, aspect.__name__, length.__name__ = "whole number", "number", "number"
