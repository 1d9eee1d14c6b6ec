# SPDX-License-Identifier: GPL-3.0-or-later
"""Which rigged assets a folder offers to learn from, and under which licences.

A folder holds `<name>.npz` files, itself or in `npz/`, and may have a `catalog.json` with `assets[]` of `name`, `npz`,
`family`, `license`, `author`, `near_duplicate_of`. What such a file holds: `rigged.py`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError

FREE_LICENCES = ("CC0", "MIT", "Apache-2.0", "BSD", "CC-BY-3.0", "CC-BY-4.0")
"""Licences under which weights learned from an asset may be passed on (CC-BY with its credit)."""


@dataclass(frozen=True)
class Asset:
    """One entry of a folder. family: assets that share rigs or meshes, never split between train and test."""

    name: str
    path: Path
    family: str
    license: str = ""
    author: str = ""


def list_assets(folder: Path, *, any_licence: bool = False, near_duplicates: bool = False) -> list[Asset]:
    """The assets of a folder, in the catalogue's order or by name.

    Where a catalogue states licences, only assets of `FREE_LICENCES` are taken unless `any_licence`, and no
    `near_duplicates` of others unless these are asked for; without a catalogue the folder's owner answers for them, and
    every asset is a family of its own.

    Raises:
        InputError: there is no such folder, nothing in it to learn from, or an entry lacks a value. Whether a file is
            there shows when it is read.
    """
    if not folder.is_dir():
        raise InputError(
            f"The assets' folder '{folder}' does not exist; name a folder of rigged .npz assets, with or without a "
            "catalog.json."
        )
    catalog = folder / "catalog.json"
    if catalog.is_file():
        entries = [e for e in _entries(catalog) if near_duplicates or not e.get("near_duplicate_of")]
        found = [_asset(folder, entry) for entry in entries]
        if not any_licence:
            found = [asset for asset in found if asset.license in FREE_LICENCES]
            if entries and not found:
                free = ", ".join(FREE_LICENCES)
                raise InputError(f"No asset of '{catalog}' has a licence to learn from: its license is none of {free}.")
    else:
        inner = folder / "npz" if (folder / "npz").is_dir() else folder
        found = [Asset(path.stem, path, path.stem) for path in sorted(inner.glob("*.npz"))]
    if not found:
        raise InputError(f"'{folder}' holds no assets to learn from; put rigged .npz assets there.")
    return found


def _entries(catalog: Path) -> list[dict[str, Any]]:
    try:
        entries = [e for e in json.loads(catalog.read_text(encoding="utf-8"))["assets"] if e["name"] and e["npz"]]
        for entry in entries:
            for key in ("family", "license"):
                entry[key]
        return entries
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"'{catalog}' is not a catalogue of assets ({error}); correct or remove it.") from None


def _asset(folder: Path, entry: dict[str, Any]) -> Asset:
    return Asset(
        str(entry["name"]),
        folder / str(entry["npz"]),
        str(entry["family"]),
        str(entry["license"]),
        str(entry.get("author") or ""),
    )
