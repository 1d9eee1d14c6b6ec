# SPDX-License-Identifier: GPL-3.0-or-later
"""A .glb without what Blender's importer takes in another way than it is meant."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.splats.gltf import EXTENSION_NAME


@contextmanager
def readable(path: Path, *, skeletons: bool = True) -> Iterator[Path]:
    """A copy of a .glb for Blender's importer, or the file itself where there is nothing to leave out, and a .gltf.

    From Blender 5.3 the importer makes point clouds of splats, which follow no bones, and fails where they have a
    skin: in the copy they are points. Without `skeletons` skins name no skeleton root: Blender takes inverse bind
    matrices for relative to that root, which they are not (glTF 2.0, 3.7.3.1); where the armature is moved or scaled,
    its bones would stand elsewhere at rest. A damaged file is left to the importer's words.
    """
    data = path.read_bytes() if path.suffix.lower() == ".glb" else b""
    end = 20 + int.from_bytes(data[12:16], "little")
    changed = False
    try:
        document = json.loads(data[20:end])
    except (ValueError, RecursionError):
        document = {}
    try:
        for mesh in document.get("meshes", ()):
            for primitive in mesh["primitives"]:
                changed |= primitive.get("extensions", {}).pop(EXTENSION_NAME, None) is not None
        for skin in () if skeletons else document.get("skins", ()):
            changed |= skin.pop("skeleton", None) is not None
    except (AttributeError, KeyError, TypeError):
        changed = False
    if not changed:
        yield path
        return
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[end:]
    with tempfile.TemporaryDirectory(prefix="gskin-import-") as folder:
        copy = Path(folder) / path.name
        head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
        copy.write_bytes(head + text + rest)
        yield copy
