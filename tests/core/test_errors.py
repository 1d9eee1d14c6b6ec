# SPDX-License-Identifier: GPL-3.0-or-later
"""One sentence for a terminal, and the same without flags for a window."""

from __future__ import annotations

import json

import pytest
import worker_jobs as jobs

from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.job.checks import check_inputs
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.worker import own_python, process
from gskin_addon.core.worker.client import WorkerClient, WorkerError


def test_what_the_command_line_adds_stands_in_brackets():
    error = InputError("The rod is bent; straighten it.", terminal="--straight")
    assert str(error) == "The rod is bent; straighten it (--straight)."
    assert error.plain == "The rod is bent; straighten it."
    assert GSkinError("As it is.").plain == str(GSkinError("As it is.")) == "As it is."


@pytest.mark.parametrize("move", [lambda ends: ends[:, [0, 2, 1]] * (1, -1, 1), lambda ends: ends + 40])
def test_axes_are_told_to_a_window_without_flags(move):
    cloud, rig = jobs.rod()
    lying = Skeleton(rig.names, rig.parents, move(rig.heads), move(rig.tails))
    with pytest.raises(InputError, match="--ply-up") as caught:
        check_inputs(cloud, lying)
    assert "does not overlap" in caught.value.plain
    assert "--" not in caught.value.plain


@pytest.mark.parametrize("needs_runtime", [True, False])
def test_a_missing_python_is_told_without_variables(monkeypatch, needs_runtime):
    monkeypatch.setattr(own_python, "own_python", lambda: None)
    monkeypatch.setattr(own_python, "find_worker_python", lambda preference: None)
    with pytest.raises(InputError, match="GSKIN_PYTHON") as caught:
        own_python.job_python(needs_runtime)
    assert "preferences" in caught.value.plain
    assert "GSKIN_PYTHON" not in caught.value.plain
    assert "--" not in caught.value.plain


def test_an_old_python_says_both(monkeypatch, capsys):
    monkeypatch.setattr(process.sys, "version_info", (3, 9, 1))
    assert process.main(["somewhere"]) == 2
    said = json.loads(capsys.readouterr().out)
    assert said["error"].endswith("preferences (or GSKIN_PYTHON).")
    assert said["plain"].endswith("preferences.")


def test_the_workers_plain_sentence_arrives(tmp_path):
    program = tmp_path / "worker.py"
    said = {"stage": "error", "error": "It failed (--so).", "plain": "It failed.", "traceback": "", "exit_code": 2}
    program.write_text(f"print({json.dumps(said)!r}, flush=True)")
    client = WorkerClient(own_python.sys.executable, jobs.make_job(tmp_path / "job"), program=program)
    client.start()
    with pytest.raises(WorkerError, match="--so") as caught:
        client.wait()
    assert caught.value.plain == "It failed."


def test_a_worker_that_vanishes_is_told_without_variables(tmp_path):
    program = tmp_path / "worker.py"
    program.write_text("raise SystemExit(3)")
    client = WorkerClient(own_python.sys.executable, jobs.make_job(tmp_path / "job"), program=program)
    client.start()
    with pytest.raises(WorkerError, match="GSKIN_PYTHON") as caught:
        client.wait()
    assert "without a result" in caught.value.plain
    assert "GSKIN_PYTHON" not in caught.value.plain
