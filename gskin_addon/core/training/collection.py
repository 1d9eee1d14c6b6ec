# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder of imported assets: `npz/` and `catalog.json`, as `catalogue.py` reads it, with what was not imported."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from numpy.typing import NDArray

from ..errors import InputError
from ..files import write_arrays, write_json
from .rigged import read_rigged_mesh

CATALOGUE, FOLDER = "catalog.json", "npz"


@dataclass(frozen=True)
class Wanted:
    """A file to import: its path, the asset's name, and its content's digest, by which a later run knows it."""

    path: Path
    name: str
    digest: str

    def same_as(self, entry: Any) -> bool:
        """Whether an entry of the catalogue was imported from this file."""
        source = entry.get("source") if isinstance(entry, dict) else None
        return isinstance(source, dict) and source.get("blake2b") == self.digest and entry.get("name") == self.name


class Collection:
    """The catalogue of `folder`, kept on disk after every change."""

    def __init__(self, folder: Path) -> None:
        """Read it where it is there. Raises InputError where it is no catalogue."""
        self.folder, self._path = folder, folder / CATALOGUE
        self.table: dict[str, Any] = {"assets": [], "failed": []}
        if not self._path.is_file():
            return
        try:
            found = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"'{self._path}' cannot be read ({error}); remove it or choose another --out.") from None
        self.table |= found if isinstance(found, dict) else {"assets": None}
        if not all(isinstance(self.table[name], list) for name in ("assets", "failed")):
            raise InputError(f"'{self._path}' is no catalogue of assets; remove it or choose another --out.")

    def has(self, wanted: Wanted) -> bool:
        """Whether the file was imported already and its arrays are there."""
        return npz_path(self.folder, wanted.name).is_file() and any(map(wanted.same_as, self.table["assets"]))

    def add(self, wanted: Wanted, facts: dict[str, Any]) -> None:
        """Note an asset that was imported."""
        source = {"file": wanted.path.name, "blake2b": wanted.digest}
        entry = {"name": wanted.name, "npz": f"{FOLDER}/{wanted.name}.npz", **facts, "source": source}
        self._put("assets", [entry], wanted.name)

    def fail(self, wanted: Wanted, reason: str) -> None:
        """Note a file that could not be imported."""
        self._put("failed", [{"name": wanted.name, "file": wanted.path.name, "reason": reason}], wanted.name)

    def names(self) -> dict[str, str]:
        """The names of the assets by their source's digest."""
        entries = [entry for entry in self.table["assets"] if isinstance(entry, dict)]
        sources = [(entry.get("source"), entry.get("name")) for entry in entries]
        return {str(source.get("blake2b")): str(name) for source, name in sources if isinstance(source, dict)}

    def _put(self, where: str, entries: list[Any], name: str) -> None:
        for kind in ("assets", "failed"):
            self.table[kind] = [e for e in self.table[kind] if not (isinstance(e, dict) and e.get("name") == name)]
        self.table[where] = sorted([*self.table[where], *entries], key=lambda entry: str(entry.get("name")))
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self._path, self.table)


def npz_path(folder: Path, name: str) -> Path:
    """Where the arrays of an asset lie."""
    return folder / FOLDER / f"{name}.npz"


def wanted_files(given: Sequence[Path], suffixes: Sequence[str], collection: Collection) -> list[Wanted]:
    """The files among `given` and in its folders, however deep, each content once, with names of their own.

    A content that `collection` knows keeps its name there; another of the same file name gets its digest added.

    Raises:
        InputError: a path does not exist, or nothing is there to import.
    """
    paths: list[Path] = []
    for path in given:
        if path.is_dir():
            paths += sorted(p for p in path.rglob("*") if p.suffix.lower() in suffixes and p.is_file())
        elif path.is_file():
            paths.append(path)
        else:
            raise InputError(f"'{path}' does not exist; check the path.")
    if not paths:
        raise InputError(f"'{given[0]}' holds no rigged models; give {', '.join(suffixes)} files or folders of them.")
    known = collection.names()
    found: dict[str, Wanted] = {}
    names = {name.lower() for name in known.values()}
    for path in paths:
        digest = content_digest(path)
        if digest in found:
            continue
        name = known.get(digest, "")
        if not name:
            name = re.sub(r"[^\w-]+", "_", path.stem).strip("_")[:80] or "asset"
            name = f"{name}_{digest[:6]}" if name.lower() in names else name
        names.add(name.lower())
        found[digest] = Wanted(path, name, digest)
    return list(found.values())


def content_digest(path: Path) -> str:
    """32 hexadecimal digits that stand for the content of a file, and of the files beside it that a .gltf names: two of
    one skeleton may differ in nothing but a texture."""
    whole = hashlib.blake2b(digest_size=16)
    for part in (path, *(_parts_of(path) if path.suffix.lower() == ".gltf" else ())):
        with part.open("rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                whole.update(block)
    return whole.hexdigest()


def _parts_of(path: Path) -> list[Path]:
    """The buffers and pictures that a .gltf names and that are there."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        entries = [*table.get("buffers", []), *table.get("images", [])]
        names = [unquote(entry["uri"]) for entry in entries if isinstance(entry.get("uri"), str)]
        return [part for name in names if not name.startswith("data:") and (part := path.parent / name).is_file()]
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):  # whatever the importer will say of it
        return []


def write_asset(folder: Path, name: str, arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Write the arrays of an asset and read them back as training will; returns the facts for its entry.

    Raises:
        InputError: training could not use them.
    """
    path = npz_path(folder, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, arrays)
    try:
        mesh = read_rigged_mesh(path)
        if not mesh.used.any():
            raise InputError(f"'{name}' has no bone that carries weights; leave it out.")
    except InputError:
        path.unlink()
        raise
    return {
        "family": rig_family(arrays["bone_names"], arrays["bone_parent"]),
        "n_verts": len(arrays["verts"]),
        "n_tris": len(arrays["faces"]),
        "n_bones": len(arrays["bone_parent"]),
        "n_bones_weighted": int(arrays["bone_used"].sum()),
        "color_source": "texture" if "texture_0" in arrays else "material-colours",
    }


def rig_family(names: NDArray[Any], parents: NDArray[Any]) -> str:
    """The family of an asset: assets of one skeleton, whatever the order of its bones, share it."""
    pairs = zip(names, parents, strict=True)
    bones = sorted((str(name), str(names[parent]) if parent >= 0 else "") for name, parent in pairs)
    return f"rig {hashlib.blake2b(json.dumps(bones).encode(), digest_size=4).hexdigest()}"
