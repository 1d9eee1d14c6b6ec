# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat files by what they hold: the one place that knows which formats are read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..ticks import run_to_end
from .axes import rotate_cloud, up_rotation
from .cloud import SplatCloud
from .gltf_container import MAGIC as GLB
from .gltf_file import UP as GLTF_UP
from .gltf_file import read_gltf, write_gltf
from .ksplat import read_ksplat, write_ksplat
from .loaded import LoadedSplats, Reading
from .other_formats import REMEDIES, TRANSFORM
from .ply import read_ply_pieces, write_ply
from .ply_codec import NORMALS
from .ply_compressed_write import write_compressed
from .sog import MAGIC as ZIP
from .sog import META, read_sog
from .sog_write import write_sog
from .splat import read_splat, write_splat
from .spz import MAGIC as SPZ
from .spz import UP as SPZ_UP
from .spz import read_spz, write_spz

GZIP = b"\x1f\x8b"

Reader = Callable[[Path, bool], Reading]
"""(file, leave invalid splats out) -> a reading of splats with the file's own axes; InputError for what is no such."""
Writer = Callable[[Path, SplatCloud], None]
"""Write the splats, given in the format's own axes, whole or not at all."""


@dataclass(frozen=True)
class SplatFormat:
    """suffixes: that its files end in, lower case; magics: byte strings that they start with; read, write;
    up: the axis of `UP_AXES` that points up by the format's own rules, "" where it has none.
    """

    suffixes: tuple[str, ...]
    magics: tuple[bytes, ...]
    read: Reader
    write: Writer
    up: str = ""


FORMATS: dict[str, SplatFormat] = {
    "ply": SplatFormat((".ply",), (b"ply\n", b"ply\r"), read_ply_pieces, write_ply),
    "compressed ply": SplatFormat((".compressed.ply",), (), read_ply_pieces, write_compressed),
    "splat": SplatFormat((".splat",), (), read_splat, write_splat),
    "ksplat": SplatFormat((".ksplat",), (), read_ksplat, write_ksplat),
    "spz": SplatFormat((".spz",), (SPZ, GZIP), read_spz, write_spz, SPZ_UP),
    "gltf": SplatFormat((".glb", ".gltf"), (GLB,), read_gltf, write_gltf, GLTF_UP),
    "sog": SplatFormat((".sog",), (ZIP,), read_sog, write_sog),
}
"""By name; another format is one file beside `ply.py` and one entry here."""

SUFFIXES = tuple(suffix for form in FORMATS.values() for suffix in form.suffixes)
FILE_TYPES = tuple(dict.fromkeys(f".{suffix.rpartition('.')[2]}" for suffix in SUFFIXES))
"""What file browsers and handlers of dropped files look at: the part after the last dot."""


def read_splats(path: Path, *, drop_invalid: bool = False) -> LoadedSplats:
    """Read a file of any known format, recognised by its first bytes, else by its name.

    Splats with NaN, infinite values or a quaternion of norm 0 are left out with `drop_invalid`, else an error.

    Raises:
        InputError: no such file, no known format, or a damaged file.
    """
    return run_to_end(reading(path, drop_invalid=drop_invalid))


def reading(path: Path, *, drop_invalid: bool = False) -> Reading:
    """`read_splats` piece by piece."""
    return find_format(path).read(path, drop_invalid)


def write_splats(path: Path, cloud: SplatCloud, *, up: str = "z") -> None:
    """Write the splats, whose up axis is `up`, in the format that the name of the file asks for.

    They are turned where the format has axes of its own (`SplatFormat.up`), else their axes stay.

    Raises:
        InputError: an unknown suffix. GSkinError: the file cannot be written; what was there stays.
    """
    form = output_format(path)
    if cloud.count == 0:
        raise InputError(f"'{path}': there are no splats to write; select at least one.")
    if form.up and form.up != up:
        cloud = rotate_cloud(cloud, up_rotation(form.up).T @ up_rotation(up))
    form.write(path, cloud)


def left_out(path: Path, cloud: SplatCloud) -> tuple[str, ...]:
    """Clauses about what a cloud has that the format of a file to be written has no place for. InputError as above."""
    if output_format(path) is FORMATS["ply"]:
        return ()
    words = []
    columns = [name for name in cloud.extra if name not in NORMALS]
    if columns:
        words.append(f"the format has no place for the columns {', '.join(columns)}")
    if cloud.offset.any():
        place = ", ".join(f"{value:.12g}" for value in cloud.offset)
        words.append(f"its coordinates are near the origin: ({place}) must be added; .ply output has them whole")
    return tuple(words)


def output_format(path: Path) -> SplatFormat:
    """The format that the name of a file to be written asks for. Raises InputError for other names."""
    form = FORMATS["sog"] if path.name.lower() == META else named_format(path)
    if form is None:
        raise InputError(f"'{path}' is no {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file; choose another name.")
    return form


def named_format(path: Path) -> SplatFormat | None:
    """The format that a file's name asks for; of several the one with the longest suffix. None where none does."""
    name = path.name.lower()
    found = [(len(suffix), form) for form in FORMATS.values() for suffix in form.suffixes if name.endswith(suffix)]
    return max(found, key=lambda pair: pair[0])[1] if found else None


def find_format(path: Path) -> SplatFormat:
    """The format of a file that is there, by its first bytes, else by its name. Raises InputError for others."""
    if (path / META).is_file() or (path.name.lower() == META and path.is_file()):
        return FORMATS["sog"]
    start = b""
    if path.is_file():
        try:
            with path.open("rb") as file:
                start = file.read(16)
        except OSError as error:
            raise InputError(f"'{path}' cannot be read ({error.strerror or error}); check the path.") from error
    what = REMEDIES.get(path.suffix.lower())
    if what is not None and start.startswith((ZIP, GZIP)):
        raise InputError(f"'{path}' is {what}.")  # others also have zips and gzip streams
    named = named_format(path)
    if named is not None and not named.magics and start.startswith(GZIP):
        return named  # a coordinate may begin with these two bytes
    for form in FORMATS.values():
        if start.startswith(form.magics):
            return form
    if named is not None:
        if not path.is_file():
            raise InputError(f"'{path}' does not exist; check the path of the splats.")
        return named  # its reader says what is wrong with the first bytes
    if not path.exists():
        raise InputError(f"'{path}' does not exist; check the path of the splats.")
    if what is not None:
        raise InputError(f"'{path}' is {what}.")
    raise InputError(
        f"'{path}' is no {', '.join(SUFFIXES)} file or folder of a .sog; export the splats as .ply, or {TRANSFORM}."
    )
