# SPDX-License-Identifier: GPL-3.0-or-later
"""The lines of RigNet's text of a rig (Xu et al. 2020) that say its joints and their tree.

`joints NAME X Y Z`, `root NAME`, `hier PARENT CHILD`. Puppeteer, MagicArticulate and SkinTokens write them, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError

LARGEST = 512 << 20
"""Bytes of such a text; one with the weights of a million vertices has a fifth of it."""


@dataclass
class JointLines:
    """What the lines said so far: places of the joints, the parent of each that has one, and the roots."""

    joints: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    roots: list[str] = field(default_factory=list)

    def take(self, words: list[str]) -> bool:
        """Take in a line, split at spaces; False where it is none of these. Raises ValueError with the reason where it
        is one and damaged."""
        kind, *rest = words or [""]
        if (kind, len(rest)) == ("joints", 4):
            if rest[0] in self.joints:
                raise ValueError(f"the joint '{rest[0]}' comes twice")
            self.joints[rest[0]] = (float(rest[1]), float(rest[2]), float(rest[3]))
        elif (kind, len(rest)) == ("root", 1):
            self.roots.append(rest[0])
        elif (kind, len(rest)) == ("hier", 2):
            if rest[1] in self.parents:
                raise ValueError(f"the joint '{rest[1]}' has two parents")
            self.parents[rest[1]] = rest[0]
        elif kind in {"joints", "root", "hier"}:
            raise ValueError(f"'{' '.join(words)[:40]}' is no line of a rig")
        else:
            return False
        return True

    def unknown(self, more: Iterable[str] = ()) -> str | None:
        """A name that is used, in these lines or in `more`, and has no `joints` line; None where there is none."""
        used = (*self.roots, *self.parents, *self.parents.values(), *more)
        return next((name for name in used if name not in self.joints), None)

    def parent_numbers(self) -> list[int]:
        """By joint, in the order of the lines: number of its parent, -1 for a root."""
        number = {name: place for place, name in enumerate(self.joints)}
        return [number[self.parents[name]] if name in self.parents else -1 for name in self.joints]


def numbered_lines(path: Path, errors: str = "strict") -> Iterator[tuple[int, list[str]]]:
    """Number, from 1, and words of each line of a text of a rig; errors: as `open` takes it.

    Raises:
        InputError: missing, too large, or no text.
    """
    try:
        if not path.is_file():
            raise InputError(f"'{path}' does not exist; check the path of the rig.")
        size = path.stat().st_size
        if size > LARGEST:
            raise InputError(f"'{path}' has {size >> 20:,} MB, more than rigs have; choose another file.")
        with path.open(encoding="utf-8", errors=errors) as file:
            for number, line in enumerate(file, 1):
                yield number, line.split()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"'{path}' is no text of a rig ({error}); choose a file as RigNet writes it.") from None
