# SPDX-License-Identifier: GPL-3.0-or-later
"""What the learning runtime consists of: backends, packages, sizes, licences, and where they come from.

Standard library only. The requirements are fixed here; nothing that a person opens can add one.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ..errors import InputError

INDEX_VARIABLE = "GSKIN_PACKAGE_INDEX"
PYTORCH, PIP, MIRROR, WHEELS = "pytorch", "pip", "mirror", "wheels"

TORCH = "torch==2.13.0"
NEWEST_PYTHON = (3, 14)
"""The last Python that this torch is built for."""

_WORKER = ("numba>=0.60,<1", "scipy>=1.11,<2", "safetensors>=0.4,<1", "pillow>=10,<14")
_DIFFUSION = ("diffusers>=0.42,<1", "transformers>=4.50,<6", "accelerate>=1,<2", "peft>=0.14,<1")
_LICENCES = {
    "torch": "BSD-3-Clause",
    "numba": "BSD-2-Clause",
    "scipy": "BSD-3-Clause",
    "numpy": "BSD-3-Clause",
    "pillow": "MIT-CMU",
    "safetensors": "Apache-2.0",
    "diffusers": "Apache-2.0",
    "transformers": "Apache-2.0",
    "accelerate": "Apache-2.0",
    "peft": "Apache-2.0",
    "warp-lang": "Apache-2.0",
}
_IMPORTS = {"pillow": "PIL", "warp-lang": "warp"}


@dataclass(frozen=True)
class Backend:
    """A build of torch: its index at PyTorch's, about how large it is (MB), what it adds, where it runs."""

    name: str
    title: str
    index: str
    download: int
    disk: int
    runs_on: tuple[str, ...]
    extra: tuple[str, ...] = ()
    licence: str = ""


# Linux CPU: measured (docs/install.md), with the environment itself. The others: the sizes that the indexes state,
# unpacked about twice as large.
BACKENDS = {
    backend.name: backend
    for backend in (
        Backend("cpu", "Processor", "https://download.pytorch.org/whl/cpu", 205, 880, ("linux", "win32")),
        Backend(
            "cuda",
            "NVIDIA (CUDA 12.6)",
            "https://download.pytorch.org/whl/cu126",
            3300,
            6500,
            ("linux", "win32"),
            ("warp-lang>=1.19,<2",),
            "CUDA libraries: NVIDIA's own licence, not free software",
        ),
        Backend(
            "rocm",
            "AMD (ROCm 7.2)",
            "https://download.pytorch.org/whl/rocm7.2",
            6500,
            18000,
            ("linux",),
            (),
            "ROCm libraries: MIT and others",
        ),
        Backend("apple", "Apple (Metal)", "", 100, 450, ("darwin",)),
    )
}
_REST_DOWNLOAD, _REST_DISK = 120, 450
_DIFFUSION_DOWNLOAD, _DIFFUSION_DISK = 38, 256


@dataclass(frozen=True)
class Source:
    """Where packages come from.

    kind: "pytorch" (torch from PyTorch's index, the rest as pip is configured), "pip" (all as pip is configured),
    "mirror" (all from the index `place`, a URL), "wheels" (all from the folder `place`, without network).
    """

    kind: str = PYTORCH
    place: str = ""

    def flags(self, backend: Backend, *, torch: bool) -> list[str]:
        """Options for pip or uv, for torch itself or for the rest."""
        if self.kind == WHEELS:
            return ["--no-index", f"--find-links={self.place}"]
        if self.kind == MIRROR:
            return [f"--index-url={self.place}"]
        if self.kind == PYTORCH and torch and backend.index:
            return [f"--index-url={backend.index}"]
        return []

    @property
    def needs_network(self) -> bool:
        """Whether packages are fetched."""
        return self.kind != WHEELS

    @property
    def sentence(self) -> str:
        """Where from, for a person; a mirror's user name and password are left out."""
        if self.kind == MIRROR:
            parts = urlsplit(self.place)
            return f"from {parts.scheme}://{parts.hostname or ''}{parts.path}"
        return {
            PYTORCH: "torch from download.pytorch.org, the rest from pip's index",
            PIP: "from pip's own index",
            WHEELS: f"from the folder '{self.place}', without network",
        }[self.kind]


def parse_source(kind: str = "", place: str = "") -> Source:
    """The source of `kind`; without one $GSKIN_PACKAGE_INDEX ("pip" or a URL) decides, else "pytorch".

    Raises:
        InputError: an unknown kind, a mirror that is no URL, a wheel folder without wheels.
    """
    place = place.strip()
    if not kind:
        place = os.environ.get(INDEX_VARIABLE, "").strip()
        kind = PYTORCH if not place else PIP if place == PIP else MIRROR
    if kind in (PYTORCH, PIP):
        return Source(kind)
    if kind == MIRROR:
        parts = urlsplit(place)
        if parts.scheme not in ("https", "http", "file") or any(c.isspace() for c in place):
            raise InputError(f"The package index '{place}' is no address; write one such as https://host/simple.")
        return Source(kind, place)
    if kind == WHEELS:
        folder = Path(place).expanduser()
        if not place or not folder.is_dir():
            raise InputError(f"The wheel folder '{place}' does not exist; choose a folder with .whl files.")
        if next(folder.glob("*.whl"), None) is None:
            raise InputError(f"The wheel folder '{folder}' holds no .whl file; fill it with `pip download` first.")
        return Source(kind, str(folder.absolute()))
    raise InputError(f"'{kind}' is no source of packages; choose pytorch, pip, mirror or wheels.")


@dataclass(frozen=True)
class Choice:
    """What to install, and where from."""

    backend: Backend
    diffusion: bool = True
    source: Source = Source()

    @property
    def rest(self) -> tuple[str, ...]:
        """Requirements beside torch."""
        return (*_WORKER, *(_DIFFUSION if self.diffusion else ()), *self.backend.extra)

    @property
    def names(self) -> tuple[str, ...]:
        """The packages asked for; numpy comes with scipy."""
        asked = (TORCH, *self.rest, "numpy")
        return tuple(text.replace("=", ">").split(">")[0] for text in asked)

    @property
    def modules(self) -> tuple[str, ...]:
        """What has to import afterwards."""
        return tuple(_IMPORTS.get(name, name) for name in self.names)

    @property
    def recipe(self) -> str:
        """A digest of the requirements: a runtime made by another recipe is outdated."""
        return hashlib.sha256("\n".join((TORCH, *self.rest)).encode()).hexdigest()[:16]

    @property
    def download(self) -> int:
        """About how much is fetched, MB."""
        return self.backend.download + _REST_DOWNLOAD + (_DIFFUSION_DOWNLOAD if self.diffusion else 0)

    @property
    def disk(self) -> int:
        """About how much lies on the disk in the end, MB."""
        return self.backend.disk + _REST_DISK + (_DIFFUSION_DISK if self.diffusion else 0)

    @property
    def licences(self) -> list[str]:
        """One line per licence: the packages under it."""
        groups: dict[str, list[str]] = {}
        for name in self.names:
            groups.setdefault(_LICENCES[name], []).append(name)
        lines = [f"{licence}: {', '.join(names)}" for licence, names in groups.items()]
        return lines + ([self.backend.licence] if self.backend.licence else [])

    def arguments(self) -> list[str]:
        """As options of runtime_setup.py."""
        options = ["--backend", self.backend.name, "--source", self.source.kind]
        if self.source.place:
            options.append(f"--place={self.source.place}")
        return options if self.diffusion else [*options, "--no-diffusion"]


def find_backend(name: str) -> Backend:
    """The backend `name`; "auto" is the guess.

    Raises:
        InputError: there is none of that name, or not for this computer.
    """
    name = guess_backend() if name == "auto" else name
    if name not in BACKENDS:
        raise InputError(f"There is no backend '{name}'; choose one of auto, {', '.join(BACKENDS)}.")
    backend = BACKENDS[name]
    if sys.platform not in backend.runs_on:
        fitting = ", ".join(other.name for other in BACKENDS.values() if sys.platform in other.runs_on)
        raise InputError(f"The backend '{name}' does not exist for {platform.system()}; choose {fitting or 'none'}.")
    if name == "apple" and platform.machine() != "arm64":
        raise InputError("torch is no longer built for Macs with Intel processors; the learned default needs no torch.")
    return backend


def guess_backend(
    system: str = sys.platform,
    opens: Callable[[str], Any] = ctypes.CDLL,
    exists: Callable[[str], bool] = os.path.exists,
) -> str:
    """The backend that this computer's drivers speak for: CUDA's driver library, ROCm's device, Apple, else "cpu"."""
    if system == "darwin":
        return "apple"
    try:
        opens("nvcuda.dll" if system == "win32" else "libcuda.so.1")
        return "cuda"
    except OSError:  # no driver, which is an answer
        return "rocm" if system == "linux" and exists("/dev/kfd") else "cpu"
