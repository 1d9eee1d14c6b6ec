# SPDX-License-Identifier: GPL-3.0-or-later
"""The compared methods by name: one file each, and one line here.

`file:<name>` reads weights from a folder (`from_file.py`). `ours:<init>+<guidance>` is the whole job; `ours:default`
the job with the settings that a new user has. `<init>` may carry a preset: `ours:visibility+elastic@draft`.
"""

from __future__ import annotations

from importlib import import_module

from .base import Method, MethodInput, MethodResult, Unavailable

__all__ = ["DESCRIPTIONS", "METHODS", "Method", "MethodInput", "MethodResult", "Unavailable", "create_method"]

METHODS = {
    "initial": "initial",
    "geodesic": "initial",
    "heat_splats": "initial",
    "learned": "learned",
    "nearest": "nearest",
    "heat_mesh": "heat_mesh",
    "heat_proxy": "heat_proxy",
    "bbw": "bbw",
    "oracle": "job",
}
"""Name -> module, which has `create(name) -> Method`."""

PREFIXES = {"ours": "job", "file": "from_file", "job": "variant"}
"""What a name begins with, before a colon -> module."""

DESCRIPTIONS = {
    "initial": "the paper's initial weights (Eq. 7, visibility)",
    "geodesic": "Eq. 7 on distances through the voxelised splats",
    "learned": "learned initial weights alone, of a model that has not seen the asset's family",
    "nearest": "every splat follows its nearest bone",
    "heat_mesh": "Blender's bone heat on the true mesh, which splats do not have",
    "heat_proxy": "Blender's bone heat on a mesh made from the splats",
    "heat_splats": "bone heat on the splats themselves, with their facing (`--init heat`)",
    "bbw": "bounded biharmonic weights in the voxelised splats (libigl)",
    "oracle": "the job with perfect guidance images: what the optimiser can reach",
}


def create_method(name: str) -> Method:
    """The method called `name`.

    Raises:
        ValueError: there is none of that name. Unavailable: it exists, but not here.
    """
    prefix, colon, _ = name.partition(":")
    module = PREFIXES.get(prefix) if colon else METHODS.get(name)
    if module is None:
        raise ValueError(f"There is no method '{name}': choose of {', '.join(METHODS)}, ours:<init>+<guidance>.")
    method: Method = import_module(f".{module}", __name__).create(name)
    return method
