# SPDX-License-Identifier: GPL-3.0-or-later
"""The clicks around the learning runtime: what they ask for, what they show, and what they never do."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

bpy = pytest.importorskip("bpy")

import pretend

import gskin_addon
from gskin_addon.core.worker import runtime_folder as folders
from gskin_addon.core.worker.runtime_choice import Source
from gskin_addon.core.worker.runtime_client import RuntimeClient
from gskin_addon.operators import install_runtime
from gskin_addon.session import learning_runtime, preferences, running_job
from gskin_addon.session.readiness import guidance_remedy
from gskin_addon.ui import learning_runtime as ui
from gskin_addon.ui import preferences as ui_preferences

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the fake pip knows the layout of POSIX")

FAKE = Path(__file__).resolve().parents[1] / "helpers" / "fake_runtime_setup.py"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """gskin registered as an add-on with preferences, online, and a fake pip; where the runtime will lie."""
    monkeypatch.setenv("GSKIN_FAKE_CALLS", str(tmp_path / "calls"))
    monkeypatch.delenv("GSKIN_FAKE_PIP", raising=False)
    monkeypatch.delenv(folders.VARIABLE, raising=False)
    monkeypatch.setattr(learning_runtime, "online", lambda: True)
    monkeypatch.setattr(ui, "wrap", lambda text, width: [text])  # without a window nothing has a size
    client = functools.partial(RuntimeClient, python=sys.executable, program=FAKE)
    monkeypatch.setattr(learning_runtime, "RuntimeClient", client)
    with pretend.session(tmp_path, monkeypatch):
        monkeypatch.delenv("GSKIN_PYTHON")
        addon = bpy.context.preferences.addons.new()
        addon.module = preferences.ROOT
        addon.preferences.runtime_folder = str(tmp_path / "runtime")
        try:
            yield tmp_path / "runtime"
        finally:
            bpy.context.preferences.addons.remove(addon)


ICONS = set(bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys())


class Layout:
    """Writes down what is drawn: texts, properties, operators."""

    def __init__(self, drawn: list[str] | None = None) -> None:
        self.drawn = [] if drawn is None else drawn

    def label(self, *, text: str, icon: str = "NONE") -> None:
        assert icon in ICONS
        self.drawn.append(text)

    def prop(self, owner, name: str, **look) -> None:
        assert name in owner.bl_rna.properties
        self.drawn.append(name)

    def operator(self, name: str, *, text: str = "", icon: str = "NONE") -> None:
        assert icon in ICONS
        group, _, word = name.partition(".")
        assert word in dir(getattr(bpy.ops, group))
        self.drawn.append(name)

    def progress(self, *, factor: float, text: str) -> None:
        assert 0 <= factor <= 1
        self.drawn.append(text)

    def panel(self, name: str, **look):
        return self.box(), self.box()

    def box(self, **look):
        return Layout(self.drawn)

    row = column = box


def drawn(**look) -> str:
    layout = Layout()
    ui.draw_runtime(layout, SimpleNamespace(region=None, preferences=bpy.context.preferences), **look)
    return " | ".join(layout.drawn)


def wait_for_log(line: str) -> None:
    until = time.monotonic() + 60
    while line not in learning_runtime.state.client.log:
        assert learning_runtime.step(), learning_runtime.state.outcome
        assert time.monotonic() < until
        time.sleep(0.02)


def wait_for_end() -> None:
    until = time.monotonic() + 60
    while learning_runtime.step():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_one_click_and_jobs_find_it(folder, monkeypatch):
    monkeypatch.setattr(preferences, "find_worker_python", lambda preference: Path(preference) if preference else None)
    preferences.forget_found()
    remedy = guidance_remedy(bpy.context)
    assert remedy.operator == "gskin.install_runtime"
    assert "learning runtime" in remedy.sentence
    assert "install the learning runtime" in preferences.worker_python(bpy.context)[1]
    assert "gskin.install_runtime" in drawn()

    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    assert preferences.worker_python(bpy.context) == (folders.python_in(folder), "")
    assert guidance_remedy(bpy.context) is None
    assert drawn() == ""  # a healthy runtime takes no room in the panel
    shown = drawn(manage=True)
    assert "torch 2.13.0 (Processor)" in shown
    for name in ("gskin.repair_runtime", "gskin.remove_runtime"):
        assert name in shown


def test_your_own_python_comes_first(folder, monkeypatch):
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    preferences.addon_preferences(bpy.context).python = sys.executable
    assert preferences.worker_python(bpy.context)[0] == Path(sys.executable)
    preferences.addon_preferences(bpy.context).python = ""
    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    preferences.forget_found()
    assert preferences.worker_python(bpy.context)[0] == Path(sys.executable)


def test_progress_cancel_and_going_on(folder, monkeypatch):
    monkeypatch.setenv("GSKIN_FAKE_PIP", "hang:numba")
    learning_runtime.start(bpy.context, "install", "cpu", True)
    wait_for_log("hanging")
    shown = drawn()
    assert "55%  Packages" in shown
    assert "Collecting numba" in shown
    assert "gskin.cancel_runtime" in shown
    assert not bpy.ops.gskin.install_runtime.poll()
    assert not bpy.ops.gskin.repair_runtime.poll()
    assert not bpy.ops.gskin.remove_runtime.poll()
    begun = time.monotonic()
    assert bpy.ops.gskin.cancel_runtime() == {"FINISHED"}
    assert time.monotonic() - begun < 0.1
    assert "Stopping" in drawn()
    wait_for_end()
    assert time.monotonic() - begun < 1.0
    assert not bpy.ops.gskin.cancel_runtime.poll()
    assert learning_runtime.remedy(bpy.context).operator == "gskin.install_runtime"
    assert "install it again to go on" in drawn()
    monkeypatch.delenv("GSKIN_FAKE_PIP")
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    assert folders.look(folder).state == "ready"


def test_damage_offers_repair_and_keeps_the_choice(folder):
    assert bpy.ops.gskin.install_runtime(backend="cpu", diffusion=False) == {"FINISHED"}
    (folders.packages_in(folder) / "numba" / "__init__.py").unlink()
    learning_runtime.forget()
    assert learning_runtime.remedy(bpy.context).operator == "gskin.repair_runtime"
    assert "numba is gone" in drawn()
    assert bpy.ops.gskin.repair_runtime() == {"FINISHED"}
    assert folders.look(folder).state == "ready"
    assert folders.look(folder).manifest["diffusion"] is False
    assert learning_runtime.remedy(bpy.context) is None


def test_remove(folder):
    assert not bpy.ops.gskin.remove_runtime.poll()
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    assert bpy.ops.gskin.remove_runtime() == {"FINISHED"}
    assert not folder.exists()
    assert learning_runtime.status(bpy.context).state == "missing"
    assert "was removed" in drawn(manage=True)


def test_removing_holds_nobody_up(folder, monkeypatch):
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    go_on, remove = threading.Event(), folders.delete
    monkeypatch.setattr(folders, "delete", lambda path: (go_on.wait(10), remove(path)))
    began = time.monotonic()
    learning_runtime.remove(bpy.context)
    assert time.monotonic() - began < 0.2
    assert learning_runtime.step()
    assert "Removing" in drawn()
    assert not bpy.ops.gskin.install_runtime.poll()
    assert preferences.worker_python(bpy.context)[0] != folders.python_in(folder)
    go_on.set()
    wait_for_end()
    assert not folder.exists()
    assert bpy.ops.gskin.install_runtime.poll()


def test_what_cannot_be_deleted_is_said(folder, monkeypatch):
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}

    def refuse(path):
        raise PermissionError(13, "in use", str(path))

    monkeypatch.setattr(folders.shutil, "rmtree", refuse)
    with pytest.raises(RuntimeError, match=r"cannot be deleted \(in use\)"):
        bpy.ops.gskin.remove_runtime()
    assert learning_runtime.status(bpy.context).state == "broken"


def test_a_failure_is_shown_with_its_log(folder, monkeypatch):
    monkeypatch.setenv("GSKIN_FAKE_PIP", "fail:ERROR: [Errno 28] No space left on device")
    with pytest.raises(RuntimeError, match="disk is full"):
        bpy.ops.gskin.install_runtime(backend="cpu")
    shown = drawn()
    assert "The disk is full" in shown
    assert "No space left" in shown
    assert "gskin.install_runtime" in shown


def test_offline_fetches_nothing(folder, monkeypatch, tmp_path):
    monkeypatch.setattr(learning_runtime, "online", lambda: False)
    with pytest.raises(RuntimeError, match=r"Online access is off.*wheel folder"):
        bpy.ops.gskin.install_runtime(backend="cpu")
    assert learning_runtime.state.client is None
    assert not folder.exists()
    # A wheel folder needs no network.
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    (wheels / "torch-2.13.0-py3-none-any.whl").write_bytes(b"")
    chosen = preferences.addon_preferences(bpy.context)
    chosen.runtime_source, chosen.runtime_wheels = "wheels", str(wheels)
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    chosen.runtime_source, chosen.runtime_index = "mirror", "ftp://old"
    with pytest.raises(RuntimeError, match="no address"):
        bpy.ops.gskin.install_runtime(backend="cpu")


def test_not_while_a_job_runs(folder, monkeypatch):
    monkeypatch.setattr(running_job.state, "job", SimpleNamespace(cancel=lambda: None))
    assert not bpy.ops.gskin.install_runtime.poll()
    assert not bpy.ops.gskin.remove_runtime.poll()


def test_the_dialog_says_size_licences_and_folder_first(folder):
    layout = Layout()
    fake = SimpleNamespace(layout=layout, backend="cpu", diffusion=True, bl_rna=SimpleNamespace(
        properties={"backend": 1, "diffusion": 1}))  # fmt: skip
    install_runtime.GSKIN_OT_install_runtime.draw(fake, bpy.context)
    text = " | ".join(layout.drawn)
    for words in ("GB to fetch", "GB on the disk", str(folder), "BSD-3-Clause: torch", "outside Blender's folders"):
        assert words in text
    assert not folder.exists()


def test_the_preferences_draw_without_starting_anything(folder, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    for source, setting in (("pytorch", ""), ("mirror", "runtime_index"), ("wheels", "runtime_wheels")):
        chosen = preferences.addon_preferences(bpy.context)
        chosen.runtime_source = source
        layout = Layout()
        drawing = SimpleNamespace(layout=layout, runtime_source=source, bl_rna=chosen.bl_rna)
        drawing._draw_python = functools.partial(ui_preferences.GSkinPreferences._draw_python, drawing)
        ui_preferences.GSkinPreferences.draw(drawing, bpy.context)
        assert {"runtime_folder", "runtime_source", "python"} <= set(layout.drawn)
        assert not setting or setting in layout.drawn


def test_looking_is_quick(folder):
    assert bpy.ops.gskin.install_runtime(backend="cpu") == {"FINISHED"}
    began = time.perf_counter()
    for _ in range(20):
        learning_runtime.forget()
        learning_runtime.status(bpy.context)
    assert time.perf_counter() - began < 60  # it looks at files and starts nothing


def test_the_add_on_stops_its_installation(folder, monkeypatch):
    monkeypatch.setenv("GSKIN_FAKE_PIP", "hang:torch")
    learning_runtime.start(bpy.context, "install", "cpu", True)
    wait_for_log("hanging")
    client = learning_runtime.state.client
    gskin_addon.unregister()
    try:
        until = time.monotonic() + 2
        while client.state == "running" and time.monotonic() < until:
            client.poll()
            time.sleep(0.02)
        assert client.state == "cancelled"
        assert learning_runtime.state.client is None
    finally:
        gskin_addon.register()


def test_without_preferences_the_users_own_source_holds(monkeypatch):
    monkeypatch.setattr(learning_runtime, "addon_preferences", lambda context: None)
    monkeypatch.setenv("GSKIN_PACKAGE_INDEX", "pip")
    assert learning_runtime.chosen_source(bpy.context) == Source("pip")
