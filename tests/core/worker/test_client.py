# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import worker_jobs as jobs
from patience import HANG, wait_until
from without import output_without

from gskin_addon.core.errors import Cancelled, GSkinError, InputError
from gskin_addon.core.worker import interpreter
from gskin_addon.core.worker.client import WorkerClient, WorkerError

posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


def client_for(folder: Path, python: str = sys.executable) -> WorkerClient:
    return WorkerClient(python, folder, program=jobs.FAKE)


def follow(client: WorkerClient) -> list:
    """All events until the worker has ended."""
    events = []

    def ended() -> bool:
        events.extend(client.poll())
        return client.state != "running"

    wait_until(ended, "the worker does not end")
    return events


def test_runs_and_answers(tmp_path):
    client = client_for(jobs.make_job(tmp_path))
    assert client.state == "new"
    client.start()
    with pytest.raises(GSkinError, match="not ended"):
        client.result()
    events = follow(client)
    assert client.state == "done"
    assert [event.stage for event in events] == ["start", "steps", "write"]
    assert events[1].losses == {"l1": 0.25}
    np.testing.assert_array_equal(client.result().weights[:, 0], 1.0)
    assert "chatter on stdout" in client.log


def test_wait_is_the_whole_of_it(tmp_path):
    client = client_for(jobs.make_job(tmp_path))
    client.start()
    seen = []
    assert client.wait(seen.append).bones == ("lower", "upper")
    assert seen


@pytest.mark.parametrize("act", ["talk", "deaf"])
def test_cancel_ends_whatever_it_does(tmp_path, act):
    client = client_for(jobs.make_job(tmp_path, act=act))
    client.start()
    wait_until(lambda: any(event.stage == act for event in client.poll()))
    client.cancel()
    client.cancel()
    follow(client)
    assert client.state == "cancelled"
    with pytest.raises(Cancelled):
        client.result()


@posix
def test_a_worker_that_hears_nothing_is_killed(tmp_path):
    client = client_for(jobs.make_job(tmp_path, act="talk"))
    client.start()
    wait_until(client.poll)
    client._process.send_signal(signal.SIGSTOP)
    client.cancel()
    follow(client)
    assert client.state == "cancelled"


@posix
def test_neither_poll_nor_cancel_waits_for_the_worker(tmp_path, monkeypatch):
    """It says and does nothing any more: whoever waited for it here would wait for ever."""
    monkeypatch.setattr(WorkerClient, "KILL_AFTER", 3600.0)
    client = client_for(jobs.make_job(tmp_path, act="talk"))
    client.start()
    wait_until(client.poll)
    client._process.send_signal(signal.SIGSTOP)
    os.waitpid(client._process.pid, os.WUNTRACED)
    client.poll()
    client.cancel()
    client.poll()
    assert client._process.poll() is None
    assert client.state == "running"
    client._process.kill()
    follow(client)
    assert client.state == "cancelled"


def test_the_remote_traceback_is_carried(tmp_path):
    client = client_for(jobs.make_job(tmp_path, act="raise"))
    client.start()
    follow(client)
    assert client.state == "failed"
    with pytest.raises(WorkerError, match="the middle of the matter") as caught:
        client.result()
    assert caught.value.exit_code == 1
    assert "fake_worker.py" in caught.value.traceback


def test_an_error_of_the_listener_stops_the_worker(tmp_path):
    client = client_for(jobs.make_job(tmp_path, act="talk"))
    client.start()

    def listen(_event):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client.wait(listen)
    assert client.state == "cancelled"


def test_bad_input_keeps_its_exit_code(tmp_path):
    client = WorkerClient(sys.executable, tmp_path / "none")
    client.start()
    follow(client)
    with pytest.raises(WorkerError, match="does not exist") as caught:
        client.result()
    assert caught.value.exit_code == 2


def test_what_is_no_python(tmp_path):
    with pytest.raises(InputError, match=r"'/nowhere/python'.*GSKIN_PYTHON"):
        WorkerClient("/nowhere/python", tmp_path).start()
    program = shutil.which("false")
    if program:
        client = client_for(tmp_path, program)
        client.start()
        follow(client)
        assert client.state == "failed"
        assert "ended without a result" in client.error


def test_check_python_knows_this_one():
    report = interpreter.check_python(sys.executable)
    assert report.version == sys.version_info[:3]
    assert set(report.found) == set(interpreter.NEEDED)
    assert report.usable
    assert "torch" in report.sentence


@posix
def test_check_python_tells_what_is_wrong(tmp_path):
    bare = tmp_path / "python-bare"
    bare.write_text(f'#!/bin/sh\nexec "{sys.executable}" -S -E "$@"\n')
    bare.chmod(0o755)
    report = interpreter.check_python(bare)
    assert not report.usable
    assert report.missing == list(interpreter.NEEDED)
    assert f"{bare} -m pip install numpy scipy numba torch safetensors" in report.sentence
    for path, words in (
        (tmp_path / "none", "cannot be started"),
        (shutil.which("true"), "answer like Python"),
    ):
        assert words in interpreter.check_python(path).sentence
    slow = tmp_path / "slow"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o755)
    assert "did not answer" in interpreter.check_python(slow, timeout=0.2).sentence


def test_asking_does_not_wait(monkeypatch):
    checks = interpreter.PythonChecks()
    assert checks.known("python") is None
    answer = interpreter.PythonReport(Path("python"), fault="It is broken.")
    go_on = threading.Event()
    monkeypatch.setattr(interpreter, "check_python", lambda path: (go_on.wait(HANG), answer)[1])
    checks.ask("python")
    assert checks.asking("python")
    go_on.set()
    wait_until(lambda: not checks.asking("python"))
    assert checks.known("python") == answer
    assert not checks.warming("python")


def test_a_usable_interpreter_is_warmed_up_once_and_meanwhile_known(monkeypatch):
    found = dict.fromkeys(interpreter.NEEDED, "1")
    answer = interpreter.PythonReport(Path("python"), (3, 11, 0), found)
    go_on, warmed = threading.Event(), []
    monkeypatch.setattr(interpreter, "check_python", lambda path: answer)
    monkeypatch.setattr(interpreter, "warm_up", lambda path: (warmed.append(path), go_on.wait(HANG), "")[2])
    checks = interpreter.PythonChecks()
    checks.ask("python")
    wait_until(lambda: checks.warming("python"))
    assert checks.known("python") == answer
    go_on.set()
    wait_until(lambda: not checks.warming("python"))
    checks.ask("python")
    wait_until(lambda: not checks.asking("python"))
    assert warmed == ["python"]


@pytest.mark.skipif(os.name != "posix", reason="shell scripts stand in for interpreters")
def test_warming_up_says_what_went_wrong(tmp_path):
    python = tmp_path / "python"
    for script, words in (
        ("exit 0", ""),
        ("""echo '{"stage": "error", "error": "torch is broken."}'; exit 1""", "torch is broken."),
        ("exit 7", f"'{python}' ended with exit code 7 while it prepared."),
    ):
        python.write_text(f"#!/bin/sh\n{script}\n")
        python.chmod(0o755)
        assert interpreter.warm_up(python) == words
    assert "cannot be started" in interpreter.warm_up(tmp_path / "none")


def make_environment(prefix: Path, *, torch: bool) -> Path:
    python = prefix / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)
    if torch:
        package = prefix / "lib" / "python3.12" / "site-packages" / "torch"
        package.mkdir(parents=True)
        (package / "version.py").write_text("")
    return python


@posix
def test_finding_an_interpreter_starts_none(tmp_path, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.delenv("GSKIN_PYTHON", raising=False)
    assert interpreter.find_worker_python() == Path(sys.executable)

    named, preferred = (make_environment(tmp_path / n, torch=False) for n in ("named", "preferred"))
    assert interpreter.find_worker_python(str(preferred)) == preferred
    monkeypatch.setenv("GSKIN_PYTHON", str(named))
    assert interpreter.find_worker_python(str(preferred)) == named
    monkeypatch.setenv("GSKIN_PYTHON", str(tmp_path / "gone"))
    with pytest.raises(InputError, match=r"gone.*\$GSKIN_PYTHON"):
        interpreter.find_worker_python()
    monkeypatch.delenv("GSKIN_PYTHON")

    # Blender's own Python: no torch there
    monkeypatch.setattr(interpreter.importlib.util, "find_spec", lambda name: None)
    for name in ("VIRTUAL_ENV", "CONDA_PREFIX"):
        monkeypatch.delenv(name, raising=False)
    empty, full = (
        make_environment(tmp_path / "empty", torch=False),
        make_environment(tmp_path / "full", torch=True),
    )
    monkeypatch.setenv("PATH", str(empty.parent))
    assert interpreter.find_worker_python() is None
    monkeypatch.setenv("CONDA_PREFIX", str(full.parents[1]))
    assert interpreter.find_worker_python() == full


def test_imports_with_numpy_alone():
    """What Blender imports of the worker needs nothing but numpy."""
    imports = (
        "import gskin_addon.core.worker.client, gskin_addon.core.job.contract\n"
        "import gskin_addon.core.worker.interpreter\n"
    )
    assert output_without(("torch", "numba", "scipy", "PIL"), imports) == ""
