# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin train-guidance`, as typed."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANG, interruptible, wait_until
from rigged_assets import write_collection, write_tube

import gskin_addon
from gskin_addon import cli
from gskin_addon.core.training.guidance.pairs import PairDataset, read_manifest

PROGRAM = Path(gskin_addon.__file__).with_name("cli.py")
SMALL = ["--poses", "2", "--size", "64", "--splats", "500", "--validation", "0.3"]


@pytest.fixture
def assets(tmp_path):
    return write_collection(tmp_path / "set", {"fox": 2, "owl": 1, "ogre": 1}, {"ogre": "CC-BY-SA-3.0"})


def test_makes_pairs_and_says_so(assets, tmp_path, capsys):
    write_tube(assets / "npz" / "fox_0.npz", w_val=None)
    out = tmp_path / "pairs"
    arguments = ["train-guidance", "pairs", str(assets), "--out", str(out), *SMALL, "--progress", "json"]
    assert cli.main(arguments) == 0
    *lines, left_out, last = capsys.readouterr().err.splitlines()
    events = [json.loads(line) for line in lines]
    assert [event["fraction"] for event in events] == sorted(event["fraction"] for event in events)
    assert events[-1]["fraction"] == 1.0
    assert "'fox_0' was left out" in left_out
    assert last == f"'{out}' holds 8 pairs to train on and 8 to validate."
    assert len(PairDataset(out)) == 8


def test_choices_reach_the_data(assets, tmp_path):
    out = tmp_path / "pairs"
    more = ["--leave-out", "owl", "--any-licence", "--seed", "3", "--per-family", "1", "--progress", "none"]
    assert cli.main(["train-guidance", "pairs", str(assets), "--out", str(out), *SMALL, *more]) == 0
    manifest = read_manifest(out)
    assert sorted(asset["family"] for asset in manifest["assets"]) == ["fox", "ogre"]
    assert (manifest["settings"]["seed"], manifest["settings"]["poses_per_view"]) == (3, 2)


def test_no_assets_is_bad_input(tmp_path, capsys):
    assert cli.main(["train-guidance", "pairs", str(tmp_path / "no"), "--out", str(tmp_path / "o")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_python_without_what_it_needs_is_told(assets, tmp_path, capsys, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "numba" else real(name))
    assert cli.main(["train-guidance", "pairs", str(assets), "--out", str(tmp_path / "o")]) == 2
    text = capsys.readouterr().err
    assert "no numba" in text
    assert "pip install 'gskin_addon[worker]'" in text


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_ctrl_c_keeps_what_is_finished(tmp_path):
    assets = write_collection(tmp_path / "many", {"fox": 60, "owl": 1})
    out = tmp_path / "pairs"
    command = [sys.executable, str(PROGRAM), "train-guidance", "pairs", str(assets), "--out", str(out), *SMALL]
    process = interruptible(command, stderr=subprocess.PIPE, text=True)

    def begun() -> bool:
        assert process.poll() is None
        return (out / "manifest.json").is_file() and bool(read_manifest(out)["shards"])

    wait_until(begun)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=HANG)
    assert process.returncode == 130
    assert said.splitlines()[-1].startswith("Stopped; what is finished stays in ")
    assert 0 < len(PairDataset(out)) < 60 * 8
