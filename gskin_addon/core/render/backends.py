# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasterisers by name, and which of them "auto" stands for on this machine. Standard library only."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from ..errors import InputError

AUTO = "auto"
"""Stands for the fastest rasteriser that this machine can use."""

TRUST = 5e-3
"""Largest relative difference from the CPU on a small scene; a faulty driver or kernel is off by far more."""

WARP_DEVICE = "GSKIN_WARP_DEVICE"
"""Environment variable with the Warp device to use instead of the first CUDA one; "cpu" for tests."""


@dataclass(frozen=True)
class Backend:
    """module: in this package, with prepare(scales, colors, opacities, *, dilation, compensate) -> Scene;
    lacks: one sentence on why it cannot be used here, "" where it can."""

    module: str
    lacks: Callable[[], str]


@lru_cache(maxsize=1)
def cuda_device() -> str:
    """Name of the first CUDA device, "" if there is none; asks the driver, so that neither torch nor Warp is loaded."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return ""
    device, name = ctypes.c_int(0), ctypes.create_string_buffer(256)
    if driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0) or driver.cuDeviceGetName(name, 256, device):
        return ""
    return name.value.decode(errors="replace") or "a CUDA device"


def _lacks_warp() -> str:
    if importlib.util.find_spec("warp") is None:
        return f"The rasteriser warp needs a module; install it with: {sys.executable} -m pip install warp-lang"
    if not os.environ.get(WARP_DEVICE) and not cuda_device():
        return "The rasteriser warp found no CUDA device; install NVIDIA's driver, or choose cpu."
    return ""


BACKENDS = {
    "cpu": Backend(".cpu.backend", lambda: ""),
    "warp": Backend(".warp.backend", _lacks_warp),
}


def resolve_backend(name: str = AUTO) -> str:
    """The backend that `name` stands for. InputError if there is no such backend or it cannot be used here."""
    return choose_backend(name)[0]


def choose_backend(name: str = AUTO) -> tuple[str, str]:
    """(backend, why) for a name or "auto"; `why` is a sentence for a person, "" where there is nothing to say.

    "auto" takes Warp where there is a CUDA device and the kernels reproduce the CPU's numbers on a small scene; else
    the CPU.

    Raises:
        InputError: an unknown name, or a rasteriser that this machine cannot use.
    """
    if name == AUTO:
        return _auto()
    if name not in BACKENDS:
        raise InputError(f'There is no rasteriser "{name}"; choose one of auto, {", ".join(BACKENDS)}.')
    missing = BACKENDS[name].lacks()
    if missing:
        raise InputError(missing)
    return name, ""


@lru_cache(maxsize=1)
def _auto() -> tuple[str, str]:
    if not cuda_device():
        if sys.platform == "darwin" and platform.machine() == "arm64":
            return "cpu", "Splats are drawn by the processor: there is no rasteriser for Apple's GPU."
        return "cpu", ""
    missing = _lacks_warp()
    if missing:
        return "cpu", "A GPU is not used: " + missing
    why = _disagreement("warp")
    return ("cpu", why) if why else ("warp", f"Splats are drawn by {cuda_device()} with warp.")


def _disagreement(name: str) -> str:
    """One sentence if a backend fails or differs from the CPU on a small scene, else ""."""
    from .agreement import worst_difference

    try:
        worst = worst_difference(importlib.import_module(BACKENDS[name].module, __package__).prepare)
    except Exception as error:  # whatever a driver or a kernel raises, the CPU can do the work
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return f"The GPU is not used, because the rasteriser {name} failed on it: {lines[0][:200]}"
    if worst > TRUST:
        return f"The GPU is not used, because the rasteriser {name} draws other pictures on it than the processor."
    return ""
