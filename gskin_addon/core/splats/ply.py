# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write Gaussian splat .ply files: ascii and binary, in pieces to save memory."""

from __future__ import annotations

import os
import warnings
from collections.abc import Generator, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_atomically
from ..ticks import run_to_end
from . import ply_codec as codec
from .cloud import AnyArray, SplatCloud
from .georeference import recentre
from .loaded import LoadedSplats, Reading, damaged, finish, opened
from .ply_compressed import is_compressed, read_compressed
from .ply_header import FORMATS, TYPE_NAMES, Element, Header, format_header, read_header
from .ply_kinds import notes_of
from .ply_lists import scalar_pieces
from .up_said import up_in_comments

_CHUNK = 8192
"""Rows handled at once: small enough that a piece of the file stays in the processor's cache."""

_LINES = 1024
"""Rows of text handled at once, which take fifty times as long."""

_DIGITS = 9
"""Of the longest list in a line of text."""

_COMPLETE = "export it with all properties of 3D Gaussian splats"


def read_ply(path: str | os.PathLike[str], *, drop_invalid: bool = False) -> LoadedSplats:
    """Read a Gaussian splat .ply file: INRIA layout (any property order, SH degree 0-4, ascii or binary), or
    the compressed layout of PlayCanvas and SuperSplat.

    Properties that are not part of the layout are kept in `cloud.extra`. Splats with NaN, infinite values or
    a quaternion of norm 0 are left out with `drop_invalid`, otherwise they are an error.

    Raises InputError: no such file, not a PLY, no Gaussian splats in it, missing properties, cut off, no
    splats, invalid splats.
    """
    return run_to_end(read_ply_pieces(Path(path), drop_invalid))


def read_ply_pieces(path: Path, drop_invalid: bool) -> Reading:
    """`read_ply` piece by piece."""
    with opened(path) as (file, _):
        header = read_header(file, path)
        if is_compressed(header):
            cloud, valid = yield from read_compressed(file, header, path)
        else:
            vertex, rest = _splat_element(header, path)
            cloud, valid = yield from _read_splats(file, header, vertex, rest, path)
    return (yield from finish(path, cloud, valid, drop_invalid))


def write_ply(path: str | os.PathLike[str], cloud: SplatCloud, *, fmt: str = "binary_little_endian") -> None:
    """Write the cloud in the INRIA layout, `cloud.extra` after it; fmt as in the PLY header.

    Values that came from a file and were not changed are written with the very bits that were read. Raises
    InputError for an unknown fmt or an empty cloud, GSkinError where the file cannot be written.
    """
    path = Path(path)
    if fmt not in FORMATS:
        raise InputError(f"{fmt!r} is no PLY format; use one of {', '.join(FORMATS)}.")
    if cloud.count == 0:
        raise InputError(f"'{path}': there are no splats to write; select at least one.")
    rest = 3 * (cloud.sh.shape[1] - 1)
    dtype = _file_dtype(cloud, rest, FORMATS[fmt])

    def write(file: BinaryIO) -> None:
        file.write(format_header(fmt, cloud.count, dtype))
        for start in range(0, cloud.count, _CHUNK):
            rows = slice(start, min(start + _CHUNK, cloud.count))
            _write_rows(file, _encode(cloud, rows, rest, dtype), ascii_text=fmt == "ascii")

    write_atomically(path, write)


def _splat_element(header: Header, path: Path) -> tuple[Element, int]:
    """The vertex element of a splat file and its number of f_rest properties; InputError for other files."""
    vertex = header.element("vertex")
    if vertex is None:
        raise InputError(f"'{path}' has no vertices; choose a Gaussian splat .ply file.")
    names = set(vertex.properties)
    # Discs have two scales, balls one; a gap among them is a damaged file.
    last = max((place for place, name in enumerate(codec.SCALES) if name in names), default=2)
    needed = [name for name in codec.REQUIRED if name not in codec.SCALES[last + 1 :]]
    if names.issuperset(codec.RGB):
        needed = [name for name in needed if name not in codec.COLOR]
    missing = [name for name in needed if name not in names]
    face = header.element("face")
    is_mesh = face is not None and face.count > 0
    if missing and (is_mesh or names.isdisjoint(codec.REQUIRED[3:])):
        kind = "a mesh" if is_mesh else "a point cloud"
        raise InputError(
            f"'{path}' is {kind}, not Gaussian splats (no {', '.join(missing[:6])}, ...); "
            "choose a .ply file from a 3D Gaussian splatting program."
        )
    if missing:
        raise InputError(f"'{path}' lacks the splat properties {', '.join(missing)}; {_COMPLETE}.")
    rest = sum(name.startswith("f_rest_") for name in names)
    gaps = [name for name in codec.rest_names(rest) if name not in names]
    if gaps:
        raise InputError(f"'{path}' lacks the splat properties {', '.join(gaps[:5])}; {_COMPLETE}.")
    if rest not in codec.REST_COUNTS:
        counts = ", ".join(map(str, codec.REST_COUNTS))
        raise InputError(f"'{path}' has {rest} f_rest properties, not {counts} (degree 0-4); export it again.")
    if vertex.count == 0:
        raise InputError(f"'{path}' has no splats; export it again.")
    return vertex, rest


def _read_splats(
    file: BinaryIO, header: Header, vertex: Element, rest: int, path: Path
) -> Generator[float, None, tuple[SplatCloud, NDArray[np.bool_]]]:
    """All splats with their raw and extra columns, and True (N,) where a splat is valid."""
    pieces = _ascii_pieces if header.format == "ascii" else _binary_pieces
    standard = {*codec.standard_names(rest), codec.FILTER} - set(codec.NORMALS)
    for _ in _before(file, header, vertex, path):
        yield 0.0
    source = pieces(file, header, vertex, path)
    piece: AnyArray | None = next(source)  # checks the file's length before anything large is made
    cloud = codec.empty_cloud(vertex.count, rest)
    extra: dict[str, AnyArray] = {}
    stored: dict[str, AnyArray] = {}
    for name, code in vertex.properties.items():
        if name not in standard:
            extra[name] = np.empty(vertex.count, code)
        elif codec.is_lossy(name, code):
            stored[name] = np.empty(vertex.count, code)
    text = header.format == "ascii"
    # Text may have more digits than its type says; centres need them far from the origin.
    doubles = {name: np.empty(vertex.count) for name in codec.MEANS if text and name not in stored}
    valid = np.empty(vertex.count, dtype=bool)
    start = 0
    while piece is not None:
        rows = slice(start, start + len(piece))
        columns = {name: np.ascontiguousarray(piece[name]) for name in vertex.properties}
        for name, colour in zip(codec.COLOR, codec.RGB, strict=True):
            if name not in columns:
                columns[name] = codec.decode_color(columns[colour])
        valid[rows] = codec.decode_rows(columns, cloud, rows, rest)
        for table in (extra, stored, doubles):
            for name, column in table.items():
                column[rows] = columns[name]
        start += len(piece)
        yield start / vertex.count
        piece = next(source, None)
    said = up_in_comments(header.comments)
    cloud = replace(cloud, extra=extra, stored=stored, notes=notes_of(vertex), up=said)
    doubles.update({name: stored[name] for name in codec.MEANS if name in stored})
    return recentre(cloud, [doubles.get(name) for name in codec.MEANS], path), valid


def _truncated(path: Path, expected: int, found: int) -> InputError:
    return InputError(
        f"'{path}' is cut off: its header announces {expected} splats, the file holds {found}; copy or export it again."
    )


def _before(file: BinaryIO, header: Header, vertex: Element, path: Path) -> Iterator[None]:
    """Leave `file` at the first vertex, in steps."""
    file.seek(header.offset)
    for element in header.before(vertex.name):
        if header.format == "ascii":
            for start in range(0, element.count, _CHUNK):
                if next(islice(file, min(_CHUNK, element.count - start) - 1, None), None) is None:
                    raise _truncated(path, vertex.count, 0)
                yield
        elif element.lists:
            for _ in scalar_pieces(file, element, header.order, path):
                yield
        else:
            behind = file.tell() + element.count * element.dtype(header.order).itemsize
            if behind > os.fstat(file.fileno()).st_size:
                raise _truncated(path, vertex.count, 0)
            file.seek(behind)


def _binary_pieces(file: BinaryIO, header: Header, vertex: Element, path: Path) -> Iterator[AnyArray]:
    """The vertex rows of a binary file as structured arrays of at most _CHUNK rows; `file` is at the first."""
    dtype = vertex.dtype(header.order)
    least = dtype.itemsize + sum(np.dtype(count).itemsize for count, _ in vertex.lists.values())
    found = max(0, os.fstat(file.fileno()).st_size - file.tell()) // least
    if found < vertex.count:
        raise _truncated(path, vertex.count, found)
    if vertex.lists:
        yield from scalar_pieces(file, vertex, header.order, path)
        return
    for start in range(0, vertex.count, _CHUNK):
        yield np.fromfile(file, dtype=dtype, count=min(_CHUNK, vertex.count - start))


def _ascii_pieces(file: BinaryIO, header: Header, vertex: Element, path: Path) -> Iterator[AnyArray]:
    """The vertex rows of an ascii file as structured arrays of at most _LINES rows; `file` is at the first."""
    size = os.fstat(file.fileno()).st_size - file.tell()
    possible = size // (2 * len(vertex.names)) + 1  # a value takes a digit and a separator
    if vertex.count > possible:
        raise _truncated(path, vertex.count, possible)
    codes = vertex.properties.items()
    dtype = np.dtype([(name, "f8" if name in codec.MEANS else code) for name, code in codes])
    for start in range(0, vertex.count, _LINES):
        wanted = min(_LINES, vertex.count - start)
        lines = [line.decode("latin-1") for line in islice(file, wanted)]
        if vertex.lists:
            lines = [_without_lists(line, vertex, start + index, path) for index, line in enumerate(lines)]
        table = _parse_lines(lines, len(vertex.properties), start, path)
        if len(table) < wanted:
            raise _truncated(path, vertex.count, start + len(table))
        piece = np.empty(wanted, dtype)
        for index, name in enumerate(vertex.properties):
            with np.errstate(over="ignore", invalid="ignore"):
                piece[name] = table[:, index]
        yield piece


def _without_lists(line: str, vertex: Element, splat: int, path: Path) -> str:
    """A vertex line with its scalars only; InputError where a list is not as long as it says."""
    words, kept, at = line.split(), [], 0
    for name in vertex.names:
        if name in vertex.properties:
            kept += words[at : at + 1]
            at += 1
            continue
        length = words[at] if at < len(words) else "nothing"
        if not length.isdecimal() or len(length) > _DIGITS:
            raise damaged(path, f"splat {splat} has a list of {length[:20]} values")
        at += 1 + int(length)
    if at != len(words):
        raise damaged(path, f"splat {splat} has {len(words)} values where its lists tell {at}")
    return " ".join(kept)


def _parse_lines(lines: list[str], columns: int, start: int, path: Path) -> NDArray[np.float64]:
    """Numbers (M, columns) of text lines; InputError names the first splat that cannot be read."""
    if not lines:
        return np.empty((0, columns))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # np.loadtxt on blank lines only: an empty table
            table = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape[1] == columns:
        return table
    for index, line in enumerate(lines):
        words = line.split()
        if len(words) != columns:
            raise InputError(
                f"'{path}': splat {start + index} has {len(words)} values, expected {columns}; "
                "the file is cut off or damaged, export it again."
            )
        for word in words:
            try:
                float(word)
            except ValueError:
                raise InputError(
                    f"'{path}': splat {start + index} holds {word[:20]!r}, not a number; export the file again."
                ) from None
    raise InputError(f"'{path}' has vertex lines that cannot be read as numbers; export it again.")


def _file_dtype(cloud: SplatCloud, rest: int, order: str) -> np.dtype[Any]:
    """Row type of the file: INRIA order in float32 (doubles stay doubles), then the extra columns."""
    fields = []
    names = codec.standard_names(rest)
    far = cloud.offset.any()
    for name in names:
        column = cloud.stored.get(name) if name not in codec.NORMALS else cloud.extra.get(name)
        is_double = (far and name in codec.MEANS) or (column is not None and column.dtype.str[1:] == "f8")
        fields.append((name, order + ("f8" if is_double else "f4")))
    for name, column in cloud.extra.items():
        if name not in names:
            code = column.dtype.str[1:]
            fields.append((name, order + (code if code in TYPE_NAMES else "f8")))
    return np.dtype(fields)


def _encode(cloud: SplatCloud, rows: slice, rest: int, dtype: np.dtype[Any]) -> AnyArray:
    """Structured rows of the file."""
    columns = codec.encode_rows(cloud, rows, rest)
    piece = np.zeros(rows.stop - rows.start, dtype)
    for name in dtype.names or ():
        if name in columns:
            piece[name] = columns[name]
        elif name in cloud.extra:
            piece[name] = cloud.extra[name][rows]
    return piece


def _write_rows(file: BinaryIO, piece: AnyArray, *, ascii_text: bool) -> None:
    """Append structured rows; text with as many digits as give the same bits back."""
    if not ascii_text:
        file.write(piece.tobytes())
        return
    digits = {"f4": "%.9g", "f8": "%.17g"}
    names = piece.dtype.names or ()
    line = " ".join(digits.get(piece.dtype[name].str[1:], "%d") for name in names) + "\n"
    file.write("".join(line % row for row in piece.tolist()).encode("ascii"))
