# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding the files of a model that the user brings: a local folder, or a hub id with the user's consent.

Nothing is fetched unless `allow_download` is true; then only what the provider needs. Weights are safetensors, or
pickles read by torch's own restricted reader.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import GSkinError, InputError, first_line

if TYPE_CHECKING:
    from torch import Tensor

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+(@[\w./-]+)?")

_SAFE_TORCH = (2, 6)

CONSENT = "allow the download (the add-on's tick, or --allow-download)"


@dataclass(frozen=True)
class ModelFiles:
    """What a role of a provider needs.

    role: what it is, for messages ("FLUX.2 [klein] model"); needs: files relative to the folder, each a glob
    pattern or alternatives in a tuple, of which one must be there; licence: of the usual files, for messages;
    hub_id: where the usual files are; fetch: patterns to download, `needs` where empty.
    """

    role: str
    needs: tuple[str | tuple[str, ...], ...]
    licence: str
    hub_id: str
    fetch: tuple[str, ...] = ()

    def patterns(self) -> list[str]:
        """Patterns of the files to fetch."""
        if self.fetch:
            return list(self.fetch)
        return [p for need in self.needs for p in ((need,) if isinstance(need, str) else need)]

    def missing_in(self, folder: Path) -> list[str]:
        """The needs that `folder` lacks, in words."""
        alternatives = [(need,) if isinstance(need, str) else need for need in self.needs]
        return [
            " or ".join(options)
            for options in alternatives
            if not any(next(folder.glob(option), None) for option in options)
        ]


def is_hub_id(name: str) -> bool:
    """Whether `name` reads as `owner/name` or `owner/name@revision`, and no such folder lies here."""
    return _HUB_ID.fullmatch(name) is not None and not Path(name).exists()


def find_model(
    name: str,
    files: ModelFiles,
    *,
    allow_download: bool = False,
    tell: Callable[[str], None] = lambda message: None,
) -> Path:
    """The folder with the files of `name`, a local folder or hub id; complete.

    A hub id is looked for in the local hub cache only, unless `allow_download`; then `tell` hears of it first.

    Raises:
        InputError: nothing is named, the folder is not there, or files are missing.
        GSkinError: the download failed.
    """
    name = name.strip()
    usual = f"its files are at '{files.hub_id}' (licence: {files.licence})"
    if not name:
        raise InputError(f"No {files.role} is named: give its folder or a hub id; {usual}.")
    if is_hub_id(name):
        folder = _from_hub(name, files, allow_download, tell)
    else:
        folder = Path(name).expanduser()
        if not folder.is_dir():
            what = "is a file, not a folder" if folder.is_file() else "does not exist"
            raise InputError(f"The folder of the {files.role}, '{folder}', {what}; correct the path; {usual}.")
    missing = files.missing_in(folder)
    if missing:
        remedy = f"{CONSENT}, or name a folder that has it" if is_hub_id(name) else "put it there"
        raise InputError(f"The {files.role} '{name}' lacks '{missing[0]}' in '{folder}'; {remedy}; {usual}.")
    return folder


def _from_hub(name: str, files: ModelFiles, allow_download: bool, tell: Callable[[str], None]) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise InputError(
            f"The {files.role} '{name}' is a hub id, but huggingface_hub does not load ({error}); "
            "pip install 'gskin_addon[diffusion]' into the worker's Python, or name a folder."
        ) from None
    repository, _, revision = name.partition("@")
    if allow_download:
        tell(f"Fetching {name} (licence: {files.licence})")
    try:
        return Path(
            snapshot_download(
                repository,
                revision=revision or None,
                allow_patterns=files.patterns(),
                local_files_only=not allow_download,
            )
        )
    except Exception as error:  # of huggingface_hub, of its HTTP library, of the disk
        partial = getattr(error, "snapshot_path", None)
        if not allow_download and partial is not None:
            return Path(partial)  # some other program fetched other files; ours may be among them
        if not allow_download:
            raise InputError(
                f"The {files.role} '{name}' is not on this machine; {CONSENT}, or name a folder that has its "
                f"files (licence of '{files.hub_id}': {files.licence})."
            ) from error
        raise GSkinError(
            f"The {files.role} '{name}' could not be fetched ({first_line(error)}); check the name and the "
            "network, or name a folder that has its files."
        ) from error


def require(module: str, why: str) -> None:
    """Import `module`. Raises InputError where it does not load, with the remedy; `why`: who needs it."""
    import importlib

    try:
        importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{why} needs {module}, which does not load ({first_line(error)}); "
            "pip install 'gskin_addon[diffusion]' into the worker's Python."
        ) from None


def load_tensors(path: Path, what: str) -> dict[str, Any]:
    """The named tensors of a .safetensors file or of a .pt/.bin pickle, on the CPU; no code in it is run.

    Raises:
        InputError: the file is missing, is not what its name says, or holds numbers that no plain weights are.
    """
    import torch

    tensors: dict[str, Tensor]
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            tensors = load_file(path)
        else:
            check_pickle_reader(what, path)
            tensors = torch.load(path, map_location="cpu", weights_only=True)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"The {what} '{path}' does not exist; put it there.") from None
    except Exception as error:  # pickle, zip, safetensors and torch each have their own
        raise InputError(
            f"The {what} '{path}' cannot be read as plain weights ({first_line(error)}); get the file again."
        ) from error
    if not isinstance(tensors, dict):
        raise InputError(f"The {what} '{path}' does not hold named tensors; get the right file.")
    check_numbers(f"The {what} '{path}'", _flat(tensors))
    return tensors


def check_numbers(what: str, tensors: Iterable[tuple[str, Any]]) -> None:
    """Raise InputError where a tensor is not of decimal numbers, as in quantised models, or some are not finite.

    Both would be taken silently for weights of another size. Scalars, such as a LoRA's alpha, may be whole numbers.
    """
    import torch

    plain = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
    for key, tensor in tensors:
        if not isinstance(tensor, torch.Tensor):
            continue
        if tensor.dtype not in plain and (tensor.ndim or tensor.dtype not in (torch.int64, torch.int32)):
            kind = str(tensor.dtype).removeprefix("torch.")
            raise InputError(
                f"{what} has '{key}' as {kind}, as quantised models do; get the file with its weights as they were "
                "trained (float32, float16 or bfloat16)."
            )
        if not torch.isfinite(tensor).all():
            raise InputError(f"{what} has numbers in '{key}' that are not finite; get the file again.")


def too_many(kind: Any, report: Mapping[str, Any]) -> list[str]:
    """Tensors of a file that a model built by its config.json has no place for, and that the libraries leave out
    silently: the config is another model's, or says fewer layers.

    kind: a class of diffusers, or of transformers, whose files may also hold the other half of a model, and buffers of
    older versions: of those only layers of the same half count. report: the loading information of `from_pretrained`.
    """
    found = sorted(str(key) for key in report["unexpected_keys"])
    if not kind.__module__.startswith("transformers"):
        return found
    other = "text_model." if "Vision" in kind.__name__ else "vision_model."
    return [key for key in found if "layers." in key and not key.startswith(other)]


def _flat(tensors: Mapping[Any, Any], above: str = "") -> Iterable[tuple[str, Any]]:
    """Names and values of tables in tables."""
    for key, value in tensors.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def check_pickle_reader(what: str, path: Path) -> None:
    """Raise InputError where this torch cannot be trusted with a pickle: before 2.6 its restricted reader could be
    made to run code (CVE-2025-32434). `what` and `path`: the file to be read."""
    import torch

    version = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    if version < _SAFE_TORCH:
        raise InputError(
            f"The {what} '{path}' is a pickle, which torch {torch.__version__} does not read safely; "
            "install torch 2.6 or later into the worker's Python, or get the file as .safetensors."
        )


def stamp(folder: Path, patterns: Sequence[str] = ("*",)) -> list[list[Any]]:
    """Names, sizes and times of the files of a model, which tell whether it was exchanged."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    chosen = [(path.relative_to(folder).as_posix(), path.stat()) for path in found]
    return [
        [name, status.st_size, status.st_mtime_ns]
        for name, status in chosen
        if any(fnmatch(name, pattern) for pattern in patterns)
    ]
