# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether installed packages are whole, by their RECORD files (PyPA, "Recording installed projects")."""

from __future__ import annotations

import base64
import csv
import hashlib
from pathlib import Path

from .runtime_folder import delete

_OWN = ("pip", "setuptools", "uv")


def damaged_packages(packages: Path, *, deep: bool = False) -> dict[str, Path]:
    """Packages in the site-packages folder `packages` with lost or cut files: name -> its .dist-info folder.

    A package whose installation was interrupted has no RECORD yet. `deep` compares contents (SHA-256) too.
    """
    found = {}
    for info in sorted(packages.glob("*.dist-info")):
        name = info.name.removesuffix(".dist-info").rpartition("-")[0]
        if name not in _OWN and not _whole(packages, info, deep):
            found[name] = info
    return found


def forget_package(info: Path) -> None:
    """Delete the .dist-info folder, so that pip installs the package anew over what is there. Raises GSkinError."""
    delete(info)


def versions(packages: Path, names: tuple[str, ...]) -> dict[str, str]:
    """The installed versions of `names`, by their .dist-info folders."""
    installed = {}
    for info in packages.glob("*.dist-info"):
        name, _, version = info.name.removesuffix(".dist-info").rpartition("-")
        installed[name.lower().replace("_", "-")] = version
    return {name: installed[name] for name in names if name in installed}


def _whole(packages: Path, info: Path, deep: bool) -> bool:
    try:
        with open(info / "RECORD", newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, ValueError, csv.Error):  # no RECORD or a cut one: not whole
        return False
    if not (info / "METADATA").is_file():
        return False
    for row in rows:
        name, digest, size = (*row, "", "")[:3]
        if not digest or name.endswith(".pyc"):
            continue  # made after the installation, or RECORD itself
        path = packages / name
        try:
            if size and path.stat().st_size != int(size):
                return False
            if deep and not _matches(path, digest):
                return False
        except (OSError, ValueError):
            return False
    return bool(rows)


def _matches(path: Path, digest: str) -> bool:
    """Whether the file has the RECORD's digest, written "sha256=urlsafe base64 without padding"."""
    kind, _, wanted = digest.partition("=")
    if kind not in hashlib.algorithms_guaranteed:
        return True
    with open(path, "rb") as file:
        found = hashlib.file_digest(file, kind).digest()
    return base64.urlsafe_b64encode(found).rstrip(b"=").decode() == wanted.rstrip("=")
