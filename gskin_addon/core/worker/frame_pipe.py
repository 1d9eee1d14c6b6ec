# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames through a pipe: a line of JSON with the shapes, then the arrays' bytes. No file, nothing that runs code."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, fields
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera
from ..render.drawn_splats import DrawnSplats
from ..render.frame import Frame
from ..render.output import Output

_OBJECT = [f.name for f in fields(DrawnSplats)]
_TYPES = ("<f4", "<f8")


def pack_frame(number: int, frame: Frame, output: Output) -> list[bytes | memoryview]:
    """The message's pieces, to be written one after the other; arrays are not copied where they need not be."""
    arrays: list[NDArray[Any]] = [np.asarray(frame.triangles, "<f4")]
    objects = []
    for splats in frame.objects:
        there = [name for name in _OBJECT if getattr(splats, name) is not None]
        objects.append(there)
        arrays += [np.asarray(getattr(splats, name), "<f8" if name == "matrix" else "<f4") for name in there]
    if frame.picture is not None:
        arrays.append(np.asarray(frame.picture, "<f4"))
    camera = {name: _plain(value) for name, value in asdict(frame.camera).items()}
    head = {
        "number": number,
        "camera": camera,
        "far": None if np.isinf(frame.far) else float(frame.far),
        "objects": objects,
        "picture": frame.picture is not None,
        "arrays": [[array.dtype.str, *array.shape] for array in arrays],
        "output": asdict(output),
    }
    line = json.dumps(head, allow_nan=False).encode() + b"\n"
    return [line, *(memoryview(np.ascontiguousarray(array)).cast("B") for array in arrays if array.size)]


def read_frames(stream: BinaryIO) -> Iterator[tuple[int, Frame, Output]]:
    """(number, frame, output) of each message until the pipe closes. ValueError for what is no message."""
    while line := stream.readline():
        head = json.loads(line)
        arrays = iter([_read(stream, *shape) for shape in head["arrays"]])
        triangles = next(arrays)
        objects = [DrawnSplats(**{name: next(arrays) for name in names}) for names in head["objects"]]
        view: dict[str, Any] = head["camera"]
        camera = Camera(**view | {name: np.array(view[name]) for name in ("rotation", "translation")})
        far = np.inf if head["far"] is None else float(head["far"])
        output = Output(**{**head["output"], "background": tuple(head["output"]["background"])})
        picture = next(arrays) if head["picture"] else None
        yield int(head["number"]), Frame(objects, camera, triangles, far, picture), output


def _read(stream: BinaryIO, kind: str, *shape: int) -> NDArray[Any]:
    if kind not in _TYPES:
        raise ValueError(f"an array of type {kind}")
    array = np.empty(shape, kind)
    if array.size:
        view = memoryview(array).cast("B")
        got = 0
        while got < len(view):
            count = stream.readinto(view[got:])  # type: ignore[attr-defined]
            if not count:
                raise ValueError("the pipe closed within a frame")
            got += count
    return array


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
