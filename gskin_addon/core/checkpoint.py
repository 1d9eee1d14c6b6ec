# SPDX-License-Identifier: GPL-3.0-or-later
"""What a stopped run needs to go on, as a file that brings no code: safetensors, with the plain values as JSON in it.

torch's own format is a pickle. Its reader without code, `weights_only`, let code through before torch 2.6
(CVE-2025-32434), and a job's folder may come from anywhere.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from .errors import InputError, first_line
from .files import replaced

FORMAT = "gskin-checkpoint-1"

_DEPTH = 50


def save_checkpoint(path: Path, state: Mapping[Any, Any]) -> None:
    """Write `state`, whole or not at all.

    state: mappings, lists and tuples of each other, of tensors, and of None, bool, int, float and str. Tensors come
    back on the CPU; everything else comes back equal, and of the same kind.

    Raises:
        TypeError: there is something else in it. GSkinError: the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    tensors: dict[str, torch.Tensor] = {}
    # One entry only: safetensors keeps several in an order of its own.
    about = {FORMAT: json.dumps(_encoded(state, tensors))}
    with replaced(path) as temporary:
        try:
            save_file(tensors, temporary, about)
        except SafetensorError as error:
            # Written in Rust, it tells what the system said in words only.
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), str(error)) from error


def load_checkpoint(path: Path) -> dict[Any, Any]:
    """What `save_checkpoint` wrote.

    Raises:
        InputError: the file is missing, or is no checkpoint of this gskin; older ones were pickles.
    """
    from safetensors import safe_open

    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})[FORMAT])
            # Copies: safetensors maps the file, which the next checkpoint replaces.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118  (no mapping)
        state = _decoded(about, tensors)
    except KeyError:
        raise InputError(f"The checkpoint '{path}' is of another gskin; delete it to start anew.") from None
    except Exception as error:  # of safetensors, json, and what `_decoded` meets
        raise InputError(
            f"The checkpoint '{path}' cannot be read ({first_line(error)}); delete it to start anew."
        ) from error
    if not isinstance(state, dict):
        raise InputError(f"The checkpoint '{path}' holds no state of a run; delete it to start anew.")
    return state


def _encoded(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """`value` as JSON, its tensors moved into `tensors`. What JSON lacks is a table with one key, its kind."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int | float):
        return float(value) if isinstance(value, float) else int(value)
    if isinstance(value, list):
        return [_encoded(item, tensors) for item in value]
    if isinstance(value, tuple):
        return {"tuple": [_encoded(item, tensors) for item in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_encoded(key, tensors), _encoded(item, tensors)] for key, item in value.items()]}
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        plain = value.detach().cpu().contiguous()
        # safetensors refuses tensors that share their memory.
        taken = {tensor.untyped_storage().data_ptr() for tensor in tensors.values()}
        tensors[name] = plain.clone() if plain.untyped_storage().data_ptr() in taken else plain
        return {"tensor": name}
    raise TypeError(f"a checkpoint cannot hold a {type(value).__name__}")


def _decoded(value: Any, tensors: Mapping[str, torch.Tensor], depth: int = 0) -> Any:
    if depth > _DEPTH:
        raise ValueError("its values are nested too deeply")
    if isinstance(value, list):
        return [_decoded(item, tensors, depth + 1) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, inner),) = value.items()
    if kind == "tensor":
        return tensors[inner]
    items = [_decoded(item, tensors, depth + 1) for item in inner]
    return {"tuple": tuple, "dict": dict}[kind](items)
