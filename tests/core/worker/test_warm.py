# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

from gskin_addon.core.skinning.presets import PRESETS
from gskin_addon.core.worker import process, warm


def test_both_kinds_of_jobs_run_and_leave_nothing_behind(monkeypatch, tmp_path):
    monkeypatch.setattr(warm.tempfile, "tempdir", str(tmp_path))
    pictures, lines = [], []
    monkeypatch.setattr(warm.still, "compile_kernel", lambda: pictures.append("still"))
    warm.warm(lines.append)
    assert pictures == ["still"]
    fractions = [line["fraction"] for line in lines]
    assert fractions == sorted(fractions)
    assert {line["stage"] for line in lines[:-1]} == {"warm"}
    assert lines[-1]["stage"] == "done"
    assert sum(line["message"] == "Writing the weights" for line in lines) == 2
    assert "warm" not in PRESETS
    assert not list(tmp_path.glob("gskin-*"))


def test_caches_are_the_users(monkeypatch, tmp_path):
    monkeypatch.setattr(process.sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert process.user_cache("warp") == str(tmp_path / "gskin" / "warp")
    assert (tmp_path / "gskin" / "warp").is_dir()
