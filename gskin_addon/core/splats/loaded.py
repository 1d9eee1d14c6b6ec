# SPDX-License-Identifier: GPL-3.0-or-later
"""What every reader of splat files gives, and the ends that they share: invalid splats, files cut off, sizes."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .cloud import SplatCloud

PIECE = 16_384
"""Splats decoded at once: some milliseconds, and temporaries that stay in the processor's cache."""

EXPANSION = 50
"""The most bytes of decoded splats per byte of a compressed file; real captures stay below 10."""
FREE_BYTES = 64 << 20
"""Decoded splats that any file may hold, whatever its size."""

_INVALID = "NaN, infinite or zero-rotation values"


@dataclass(frozen=True)
class LoadedSplats:
    """What was read: the cloud, the file row of each of its splats (N,), and the file's number of rows."""

    cloud: SplatCloud
    kept: NDArray[np.int64]
    total: int

    @property
    def dropped(self) -> int:
        """Number of the file's splats that were left out as invalid."""
        return self.total - self.cloud.count


Reading = Generator[float, None, LoadedSplats]
"""A file being read: yields the share done, 0 to 1, after each piece (some milliseconds), and returns the splats."""


def pieces(count: int, size: int = PIECE) -> Iterator[slice]:
    """Consecutive slices of at most `size` rows that cover `count` rows."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def empty_splats(count: int, degree: int, up: str = "") -> SplatCloud:
    """A cloud of `count` splats to be filled; contents undefined. up: as in the cloud."""
    return SplatCloud(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, (degree + 1) ** 2, 3), np.float32),
        up=up,
    )


def finite_rows(cloud: SplatCloud, rows: slice) -> NDArray[np.bool_]:
    """True (M,) where every value of a splat is finite; normalising a quaternion of norm 0 gives NaN."""
    valid = np.isfinite(cloud.opacities[rows])
    for values in (cloud.means, cloud.scales, cloud.quats, cloud.sh.reshape(cloud.count, -1)):
        valid &= np.isfinite(values[rows]).all(axis=1)
    return valid


def finish(path: Path, cloud: SplatCloud, valid: NDArray[np.bool_], drop_invalid: bool) -> Reading:
    """The last part of a reading: leave invalid splats out, or refuse them. InputError where none is valid."""
    total = cloud.count
    bad = total - int(np.count_nonzero(valid))
    if bad == total:
        raise InputError(f"'{path}': all {bad} splats have {_INVALID}; export it again.")
    if bad and not drop_invalid:
        raise InputError(
            f"'{path}': {bad} of {total} splats have {_INVALID}; read it with Drop Invalid Splats to leave them out.",
            terminal="drop_invalid=True, --drop-invalid",
        )
    if not bad:
        return LoadedSplats(cloud, np.arange(total), total)
    kept = np.flatnonzero(valid)
    yield from _compact(cloud, kept)
    return LoadedSplats(cloud.select(slice(0, len(kept))), kept, total)


def _compact(cloud: SplatCloud, kept: NDArray[np.int64]) -> Generator[float, None, None]:
    """Move the rows `kept` to the front of the cloud's own arrays: rising, so that none is lost before it is read."""
    columns = [cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh]
    columns += [*cloud.extra.values(), *cloud.stored.values()]
    for rows in pieces(len(kept)):
        for column in columns:
            column[rows] = column[kept[rows]]
        yield 1.0


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """The file and its size; InputError where it cannot be read."""
    try:
        with path.open("rb") as file:
            yield file, os.fstat(file.fileno()).st_size
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror or error}); check the path.") from error


def damaged(path: Path, what: str) -> InputError:
    """The error for a file that is not what its format says; `what` stands in brackets."""
    return InputError(f"'{path}' is damaged ({what}); copy or export it again.")


def cut_off(path: Path, what: str) -> InputError:
    """The error for a file that ends too early."""
    return InputError(f"'{path}' is cut off ({what}); copy or export it again.")


def check_count(path: Path, count: int, degree: int, size: int) -> None:
    """InputError where the splats that a compressed file of `size` bytes announces would fill the memory, or are none.

    A small file can unpack to any size; what is decoded stays below FREE_BYTES + EXPANSION * size.
    """
    if count == 0:
        raise InputError(f"'{path}' has no splats; export it again.")
    decoded = count * 4 * (11 + 3 * (degree + 1) ** 2)
    if decoded > FREE_BYTES + EXPANSION * size:
        raise InputError(
            f"'{path}' announces {count:,} splats ({decoded >> 20:,} MB) in {size:,} bytes, "
            f"over {EXPANSION} times its size; it is damaged or made to fill the memory, export it again as .ply."
        )


def with_degree(cloud: SplatCloud, degree: int) -> SplatCloud:
    """The cloud with its harmonics cut off above `degree`, which loses them."""
    if cloud.sh_degree <= degree:
        return cloud
    return replace(cloud, sh=cloud.sh[:, : (degree + 1) ** 2])
