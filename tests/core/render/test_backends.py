# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from gskin_addon.core.errors import InputError
from gskin_addon.core.render import agreement, backends
from gskin_addon.core.render.backends import Backend, choose_backend, resolve_backend
from gskin_addon.core.render.cpu import backend as cpu


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    backends._auto.cache_clear()
    yield
    backends._auto.cache_clear()


def with_gpu(monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    """A machine with a CUDA device and the rasterisers `modules`, by the module that makes their scenes."""
    monkeypatch.setattr(backends, "cuda_device", lambda: "a test GPU")
    monkeypatch.setattr(backends, "_lacks_warp", lambda: "" if "warp" in modules else "There is no warp.")
    for name, module in modules.items():
        monkeypatch.setitem(backends.BACKENDS, name, Backend(module, lambda: ""))


def test_without_a_gpu_it_is_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "cuda_device", lambda: "")
    assert resolve_backend() == "cpu"
    monkeypatch.delenv(backends.WARP_DEVICE, raising=False)
    with pytest.raises(InputError, match="warp"):
        resolve_backend("warp")


def test_apples_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "cuda_device", lambda: "")
    monkeypatch.setattr(backends.sys, "platform", "darwin")
    monkeypatch.setattr(backends.platform, "machine", lambda: "arm64")
    name, why = choose_backend()
    assert name == "cpu"
    assert "Apple" in why


def test_a_gpu_is_taken_when_it_draws_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    with_gpu(monkeypatch, warp=".cpu.backend")
    name, why = choose_backend()
    assert name == "warp"
    assert "a test GPU" in why


def test_a_gpu_that_draws_something_else_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    with_gpu(monkeypatch, warp=".cpu.backend")
    true = cpu.prepare

    def wrong(*args: Any, **options: Any) -> Any:
        return true(args[0] * 1.01, *args[1:], **options)

    assert agreement.worst_difference(true) == 0
    monkeypatch.setattr(cpu, "prepare", wrong)
    assert agreement.worst_difference(true) > backends.TRUST
    monkeypatch.setattr(agreement, "worst_difference", lambda prepare: 0.01)
    name, why = choose_backend()
    assert name == "cpu"
    assert "other pictures" in why


def test_a_gpu_that_fails_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    with_gpu(monkeypatch, warp=".cpu.backend")

    def fail(prepare: Any) -> float:
        raise RuntimeError("no kernel image is available\nmore")

    monkeypatch.setattr(agreement, "worst_difference", fail)
    name, why = choose_backend()
    assert name == "cpu"
    assert why.endswith("no kernel image is available")


def test_a_missing_module_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install warp-lang"):
        resolve_backend("warp")


def test_menus_need_no_numba_torch_or_warp() -> None:
    code = (
        "import sys; import gskin_addon.core.job.settings; "
        "print([m for m in ('numba', 'torch', 'warp') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_the_scene_of_the_check_shows_something() -> None:
    scene = cpu.prepare(np.full((1, 3), 0.1), np.ones((1, 3)), [0.5])
    with pytest.raises(InputError):
        agreement.worst_difference(lambda *args, **options: scene)
