# SPDX-License-Identifier: GPL-3.0-or-later
"""Rows of a binary PLY element with lists: their length is known only from row to row. The lists are passed over."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .cloud import AnyArray
from .loaded import cut_off, damaged
from .ply_header import Element

_BYTES = 1 << 18
"""Bytes walked through at once, some milliseconds; more only where one row is longer."""


def scalar_pieces(file: BinaryIO, element: Element, order: str, path: Path) -> Iterator[AnyArray]:
    """The scalars of the element's rows as structured arrays; `file` is at the first row, and behind the last at the
    end. order: byte order character. Memory: `_BYTES` or the longest row.

    Raises InputError: the file ends within the element, a list of negative length.
    """
    rows = _Rows(file, element, order, path)
    while rows.left:
        yield rows.read()


class _Rows:
    """Where the lists of rows are. A row is runs of scalars, each but the last followed by a list."""

    def __init__(self, file: BinaryIO, element: Element, order: str, path: Path) -> None:
        self.file, self.element, self.path = file, element, path
        self.left = element.count
        self.dtype = element.dtype(order)
        self._size = os.fstat(file.fileno()).st_size
        sizes = [0]
        """Bytes of each run of scalars."""
        self._counts: list[tuple[struct.Struct, int]] = []
        for name in element.names:
            if name in element.properties:
                sizes[-1] += np.dtype(element.properties[name]).itemsize
                continue
            count, item = element.lists[name]
            # The letters of single numbers are the same in both modules.
            self._counts.append((struct.Struct(order + np.dtype(count).char), np.dtype(item).itemsize))
            sizes.append(0)
        self._scalars = sizes

    def read(self) -> AnyArray:
        """The next rows, as many as are whole in what is read at once; at least one."""
        at = self.file.tell()
        data = self.file.read(_BYTES)
        starts, used = self._walk(data)
        if not starts:
            length = self._length_at(at)
            self.file.seek(at)
            data = self.file.read(length)
            starts, used = self._walk(data, most=1)
        self.file.seek(at + used)
        self.left -= len(starts)
        return self._gathered(np.frombuffer(data, np.uint8), np.array(starts, np.int64))

    def _walk(self, data: bytes, most: int | None = None) -> tuple[list[list[int]], int]:
        """Where in `data` the runs of its whole rows start, and where the last of these rows ends."""
        found: list[list[int]] = []
        end, size = 0, len(data)
        counts, last = list(zip(self._scalars, self._counts, strict=False)), self._scalars[-1]
        wanted = self.left if most is None else most
        while len(found) < wanted:
            at = end
            row = []
            for scalars, (count, item) in counts:
                row.append(at)
                at += scalars
                if at + count.size > size:
                    return found, end
                (number,) = count.unpack_from(data, at)
                if number < 0:
                    raise self._negative(number)
                at += count.size + number * item
            row.append(at)
            at += last
            if at > size:
                return found, end
            found.append(row)
            end = at
        return found, end

    def _length_at(self, start: int) -> int:
        """Bytes of the row at a place in the file; InputError where the file does not have them."""
        at = start
        for scalars, (count, item) in zip(self._scalars, self._counts, strict=False):
            at += scalars
            self.file.seek(at)
            word = self.file.read(count.size)
            if len(word) < count.size:
                raise self._short()
            (number,) = count.unpack(word)
            if number < 0:
                raise self._negative(number)
            at += count.size + number * item
        at += self._scalars[-1]
        if at > self._size:
            raise self._short()
        return at - start

    def _gathered(self, data: NDArray[np.uint8], starts: NDArray[np.int64]) -> AnyArray:
        """The scalars of rows whose runs start at `starts` (rows, runs)."""
        runs = [data[starts[:, run, None] + np.arange(size)] for run, size in enumerate(self._scalars) if size]
        packed = np.concatenate(runs, axis=1) if runs else np.empty((len(starts), 0), np.uint8)
        return np.ascontiguousarray(packed).view(self.dtype).reshape(-1) if runs else np.empty(len(starts), self.dtype)

    def _short(self) -> Exception:
        read = self.element.count - self.left
        return cut_off(self.path, f"{read:,} of {self.element.count:,} rows of '{self.element.name}'")

    def _negative(self, number: int) -> Exception:
        return damaged(self.path, f"a list of {number} values in '{self.element.name}'")
