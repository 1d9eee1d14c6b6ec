# SPDX-License-Identifier: GPL-3.0-or-later
"""`file:<name>`: weights that a folder holds, of a method that does not run here (`--method-weights NAME=FOLDER`).

Which folder a name stands for goes to the worker processes by the environment, as JSON in `GSKIN_METHOD_WEIGHTS`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

from benchmarks.quality.results import Result
from benchmarks.quality.submitted import digest_of, read_submitted
from gskin_addon.core.errors import InputError

from .base import Method, MethodInput, MethodResult, Unavailable

VARIABLE = "GSKIN_METHOD_WEIGHTS"
PREFIX = "file:"


def register(pairs: Iterable[str]) -> list[str]:
    """Make NAME=FOLDER known to this process and those it starts; the names of the methods, in order.

    Raises:
        InputError: a pair of another form, a folder that is none, a name that comes twice.
    """
    folders: dict[str, str] = {}
    for pair in pairs:
        name, _, folder = pair.partition("=")
        if not folder or not name.replace("-", "").replace("_", "").isalnum():
            raise InputError(f"'{pair}' is not NAME=FOLDER; give a name of letters, digits, '-' and '_', and a folder.")
        if not Path(folder).is_dir():
            raise InputError(f"'{folder}' is no folder; give the one with the weights of '{name}'.")
        if name in folders:
            raise InputError(f"The method '{name}' comes twice; give each its own name.")
        folders[name] = str(Path(folder).resolve())
    os.environ[VARIABLE] = json.dumps(folders)
    return [PREFIX + name for name in folders]


def folder_of(method: str) -> Path | None:
    """The folder of a registered method `file:<name>`."""
    found = json.loads(os.environ.get(VARIABLE, "{}")).get(method.removeprefix(PREFIX))
    return Path(found) if found else None


def is_stale(result: Result) -> bool:
    """Whether the result is of other files than the folder holds now."""
    folder = folder_of(result.method) if result.method.startswith(PREFIX) else None
    return folder is not None and digest_of(folder, result.asset) not in result.note.replace(')', ' ').split()


def create(name: str) -> Method:
    """The method. Raises Unavailable: nobody named its folder."""
    folder = folder_of(name)
    if folder is None:
        raise Unavailable(f"no folder was given for it (--method-weights {name.removeprefix(PREFIX)}=FOLDER)")

    def make(subject: MethodInput) -> MethodResult:
        if subject.skeleton is not subject.asset.skeleton:
            raise Unavailable("its weights are of undisturbed skeletons")
        try:
            found = read_submitted(folder, subject.asset)
        except FileNotFoundError as reason:
            raise Unavailable(str(reason)) from None
        except InputError as error:
            raise InputError(f"{error} (file {digest_of(folder, subject.asset.name)})") from None
        return MethodResult(found.weights, f"{'through its mesh, ' if found.on_mesh else ''}file {found.digest}")

    return Method(make)
