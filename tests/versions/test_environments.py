# SPDX-License-Identifier: GPL-3.0-or-later
"""The tool that makes one environment per version of Blender says what it lacks."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    return importlib.import_module("version_venv")


def test_a_missing_interpreter_is_named_and_the_exit_code_says_so(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tool, "PYTHONS", {"5.3": (3, 99)})
    monkeypatch.setattr(sys, "argv", ["version_venv.py", "5.3", "--folder", str(tmp_path)])
    assert tool.main() == 1
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "install python3.99" in text
    assert not list(tmp_path.iterdir())


def test_an_environment_is_built_on_the_interpreter_not_on_another_environment(tool):
    found = tool.find_python(sys.version_info[:2])
    assert Path(found).resolve() == Path(sys._base_executable).resolve()
