# SPDX-License-Identifier: GPL-3.0-or-later
"""The header of a PLY file: elements, properties, byte order."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import InputError

TYPE_CODES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
"""NumPy code of every PLY type name."""

TYPE_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort",
    "i4": "int", "u4": "uint", "f4": "float", "f8": "double",
}  # fmt: skip
"""PLY type name of every NumPy code that PLY can hold."""

FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Byte order character of every PLY format."""

_MAX_HEADER = 1 << 20


@dataclass(frozen=True)
class Element:
    """One element: name, number of rows, NumPy code of its scalar properties by name; of its list properties the
    codes of count and items; and the names of both in the file's order.
    """

    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)
    lists: dict[str, tuple[str, str]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)

    def dtype(self, order: str) -> np.dtype[Any]:
        """Packed NumPy type of the scalars of one row in byte order `order` ("<", ">" or "=")."""
        return np.dtype([(name, order + code) for name, code in self.properties.items()])


@dataclass(frozen=True)
class Header:
    """Format name, elements in file order, the byte offset of the data, and the texts of the comments."""

    format: str
    elements: tuple[Element, ...]
    offset: int
    comments: tuple[str, ...] = ()

    @property
    def order(self) -> str:
        """Byte order character for NumPy."""
        return FORMATS[self.format]

    def element(self, name: str) -> Element | None:
        """The element called `name`, None where the file has none."""
        return next((element for element in self.elements if element.name == name), None)

    def before(self, name: str) -> tuple[Element, ...]:
        """The elements whose data comes before that of `name`."""
        names = [element.name for element in self.elements]
        return self.elements[: names.index(name)]


def read_header(file: BinaryIO, path: Path) -> Header:
    """Read the header and leave `file` at the first byte of data; InputError names what is wrong with it."""
    if file.readline(16).strip() != b"ply":
        raise InputError(f"'{path}' is not a PLY file; choose a Gaussian splat .ply file.")
    format_name = ""
    elements: list[Element] = []
    comments: list[str] = []
    while True:
        line = file.readline(4096)
        if not line.endswith(b"\n") or file.tell() > _MAX_HEADER:
            raise InputError(f"'{path}' is cut off inside its PLY header; copy or export the file again.")
        words = line.decode("latin-1").split()
        if not words or words[0] in ("comment", "obj_info"):
            comments.append(" ".join(words[1:]))
            continue
        if words[0] == "end_header":
            break
        if words[0] == "format" and len(words) == 3:
            format_name = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal():
            elements.append(Element(words[1], int(words[2])))
        elif words[0] == "property" and elements and _add_property(elements, words[1:]):
            continue
        else:
            text = " ".join(words)[:60]
            raise InputError(f"'{path}' has a header line that is not PLY ({text!r}); export the file again.")
    if format_name not in FORMATS:
        raise InputError(f"'{path}' has the PLY format {format_name!r}; use one of {', '.join(FORMATS)}.")
    return Header(format_name, tuple(elements), file.tell(), tuple(comments))


def _add_property(elements: list[Element], words: list[str]) -> bool:
    """Add a property line to the last element; False where the line is malformed or repeats a name."""
    element = elements[-1]
    name = words[-1]
    if name in element.properties or name in element.lists:
        return False
    if len(words) == 2 and words[0] in TYPE_CODES:
        element.properties[name] = TYPE_CODES[words[0]]
    elif len(words) == 4 and words[0] == "list" and _counts(words[1]) and words[2] in TYPE_CODES:
        element.lists[name] = TYPE_CODES[words[1]], TYPE_CODES[words[2]]
    else:
        return False
    element.names.append(name)
    return True


def _counts(type_name: str) -> bool:
    """Whether a number of this type can be the length of a list."""
    return TYPE_CODES.get(type_name, "f")[0] in "iu"


def format_header(format_name: str, count: int, dtype: np.dtype[Any]) -> bytes:
    """Header of a file with one element, "vertex", of `count` rows of `dtype`."""
    lines = ["ply", f"format {format_name} 1.0", f"element vertex {count}"]
    for name in dtype.names or ():
        lines.append(f"property {TYPE_NAMES[dtype[name].str[1:]]} {name}")
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
