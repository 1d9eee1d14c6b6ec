# SPDX-License-Identifier: GPL-3.0-or-later
"""Real processes: the lines, the exit codes, cancelling, crashing, dying with the parent, going on."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
import worker_jobs as jobs
from patience import HANG, wait_until

import gskin_addon
from gskin_addon.core.job import contract
from gskin_addon.core.worker import process
from gskin_addon.core.worker.client import PROGRAM

posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def start(folder: Path, program: Path = jobs.FAKE, **kwargs) -> subprocess.Popen[bytes]:
    kwargs.setdefault("stdin", subprocess.PIPE)
    kwargs.setdefault("stderr", subprocess.PIPE)
    return subprocess.Popen([sys.executable, "-u", program, folder], stdout=subprocess.PIPE, **kwargs)


def finish(worker: subprocess.Popen[bytes], timeout: float = HANG) -> tuple[list[dict], str]:
    """The lines and stderr of a worker, its stdin left open until it ends."""
    lines = [json.loads(line) for line in worker.stdout]
    worker.wait(timeout)
    return lines, worker.stderr.read().decode() if worker.stderr else ""


def wait_for(worker: subprocess.Popen[bytes], stage: str) -> None:
    for line in worker.stdout:
        if json.loads(line)["stage"] == stage:
            return
    raise AssertionError(f"no stage {stage}: {worker.stderr.read().decode()}")


def alive(pid: int) -> bool:
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    return False


def gone(pid: int) -> bool:
    wait_until(lambda: not alive(pid), f"process {pid} lives on")
    return True


def test_a_job_runs_to_its_end(tmp_path):
    folder = jobs.make_job(tmp_path)
    worker = start(folder)
    lines, stderr = finish(worker)
    assert worker.returncode == 0
    assert [line["stage"] for line in lines] == ["start", "steps", "write", "done"]
    assert lines[-2]["seconds_left"] == 0  # whatever the rate was before
    assert lines[1]["losses"] == {"l1": 0.25}  # what is not a number is left out: JSON has no NaN
    assert [line["fraction"] for line in lines] == sorted(line["fraction"] for line in lines)
    assert "chatter on stdout" in stderr and "chatter of a child" in stderr  # noqa: PT018
    result = contract.read_result(folder)
    assert result.weights.shape == (200, 2)
    assert result.report["curve"] == [1.0, None]
    assert result.report["worker"]["peak_memory_mb"] > 0 or os.name != "posix"
    assert set(result.previews) == {"rest"}


def test_a_finished_job_is_not_done_again(tmp_path):
    folder = jobs.make_job(tmp_path)
    finish(start(folder))
    before = (folder / "report.json").stat().st_mtime_ns
    lines, _ = finish(start(folder))
    assert lines[-1]["stage"] == "done"
    assert (folder / "report.json").stat().st_mtime_ns == before


def test_null_stdin_is_no_cancel(tmp_path):
    worker = start(jobs.make_job(tmp_path), stdin=subprocess.DEVNULL)
    assert finish(worker)[0][-1]["stage"] == "done"


@pytest.mark.parametrize("act", ["talk", "deaf"])
@pytest.mark.parametrize("how", ["pipe", "SIGTERM", "SIGINT"])
@linux
def test_cancel_ends_whatever_it_does(tmp_path, act, how):
    folder = jobs.make_job(tmp_path, act=act)
    worker = start(folder)
    wait_for(worker, act)
    time.sleep(0.3)
    computing = int((folder / "checkpoint" / "pid").read_text())
    if how == "pipe":
        worker.stdin.close()
    else:
        worker.send_signal(getattr(signal, how))
    lines, _ = finish(worker)
    assert worker.returncode == 130
    assert lines[-1]["stage"] == "error"
    assert lines[-1]["exit_code"] == 130
    assert gone(computing)
    assert not contract.is_finished(folder)


@posix
def test_a_signal_may_come_at_any_moment():
    """Also while the main thread holds the lock of a threading.Event, which its handler then must not want."""
    code = textwrap.dedent("""
        import signal, sys, threading
        from gskin_addon.core.worker import supervisor

        times = 0

        def trace(frame, event, argument):
            global times
            heard = signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
            if heard and event == "line" and times < 200 and frame.f_code.co_filename == threading.__file__:
                times += 1
                signal.raise_signal(signal.SIGTERM)
            return trace

        sys.settrace(trace)
        sys.exit(supervisor.supervise([sys.executable, "-c", "import time; time.sleep(600)"]))
    """)
    run = subprocess.run(
        [sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=HANG
    )
    assert run.returncode == 130, run.stderr


@linux
def test_dies_with_a_parent_that_was_killed(tmp_path):
    folder = jobs.make_job(tmp_path, act="deaf")
    # The grandparent (this test) keeps the pipe's other end open: only the parent's death can be the reason.
    code = (
        "import subprocess, sys, time\n"
        f"w = subprocess.Popen([sys.executable, '-u', {str(jobs.FAKE)!r}, {str(folder)!r}])\n"
        "print(w.pid, flush=True); time.sleep(600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    supervisor = int(parent.stdout.readline())
    wait_for(parent, "deaf")
    computing = int((folder / "checkpoint" / "pid").read_text())
    assert alive(computing)
    parent.kill()
    parent.wait()
    assert gone(supervisor)
    assert gone(computing)


@linux
def test_computing_dies_with_a_supervisor_that_was_killed(tmp_path):
    folder = jobs.make_job(tmp_path, act="deaf")
    worker = start(folder)
    wait_for(worker, "deaf")
    computing = int((folder / "checkpoint" / "pid").read_text())
    worker.kill()
    assert gone(computing)


def test_an_error_comes_with_its_traceback(tmp_path):
    worker = start(jobs.make_job(tmp_path, act="raise"))
    last = finish(worker)[0][-1]
    assert worker.returncode == last["exit_code"] == 1
    assert "RuntimeError: the middle of the matter" in last["error"]
    assert "fake_worker.py" in last["traceback"]
    assert not contract.is_finished(tmp_path)


@pytest.mark.parametrize(("act", "words"), [("crash", "SIGSEGV"), ("vanish", "exit code 3")])
@posix
def test_a_crash_gets_a_last_word(tmp_path, act, words):
    worker = start(jobs.make_job(tmp_path, act=act))
    last = finish(worker)[0][-1]
    assert worker.returncode == last["exit_code"] == 1
    assert words in last["error"]


@linux
def test_killed_in_the_middle_goes_on(tmp_path):
    folder = jobs.make_job(tmp_path, act="resume")
    worker = start(folder)
    wait_until((folder / "checkpoint" / "step").exists)
    os.kill(int((folder / "checkpoint" / "pid").read_text()), signal.SIGKILL)
    lines, _ = finish(worker)
    assert worker.returncode == 1
    assert "memory" in lines[-1]["error"]
    reached = int((folder / "checkpoint" / "step").read_text())
    assert 0 < reached < 10
    jobs.make_job(folder, act="resume")  # as a second click does
    lines, _ = finish(start(folder))
    assert lines[-1]["stage"] == "done"
    assert contract.read_result(folder).report["settings"]["first"] == reached


@linux
def test_two_workers_do_not_share_a_job(tmp_path):
    folder = jobs.make_job(tmp_path, act="talk")
    first = start(folder)
    wait_for(first, "talk")
    second = start(folder)
    last = finish(second)[0][-1]
    assert second.returncode == 2
    assert "is being run by process" in last["error"]
    first.kill()
    first.wait()


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_full_disk_while_the_job_writes(tmp_path):
    import resource

    folder = jobs.make_job(tmp_path, act="finish")

    def limit() -> None:  # the weights of 200 splats and two bones take 1.6 kB and more
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    worker = start(folder, preexec_fn=limit)
    last = finish(worker)[0][-1]
    assert worker.returncode == last["exit_code"] == 1
    assert "The disk is full" in last["error"]
    assert "weights.npz" in last["error"]
    assert not contract.is_finished(folder)
    assert not list(folder.glob(".*tmp"))


def test_no_job_there(tmp_path):
    for folder, words in ((tmp_path / "none", "does not exist"), (tmp_path, "job.json' is missing")):
        worker = start(folder)
        last = finish(worker)[0][-1]
        assert worker.returncode == 2
        assert words in last["error"]


def test_program_takes_one_folder():
    run = subprocess.run([sys.executable, PROGRAM], capture_output=True)
    assert run.returncode == 2
    assert "JOBDIR" in json.loads(run.stdout)["error"]


def test_loads_a_package_anywhere_without_touching_the_path(tmp_path):
    # As Blender has it: the folder of an extension, under another name, without gskin being installed.
    root = Path(gskin_addon.__file__).parent
    home = tmp_path / "user_default" / "gskin_copy"
    shutil.copytree(root, home, ignore=shutil.ignore_patterns("__pycache__"))
    program = home / "core" / "worker" / "process.py"
    code = textwrap.dedent(f"""
        import sys, runpy
        before = list(sys.path)
        module = runpy.run_path({str(program)!r})
        name = module["load_package"]()
        import gskin_addon.core.job.contract as contract
        assert name == "gskin_addon" and sys.path == before, sys.path
        print(contract.__file__)
    """)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert Path(run.stdout.strip()) == home / "core" / "job" / "contract.py", run.stderr
    worker = subprocess.run(
        [sys.executable, "-u", program, tmp_path / "none"], stdin=subprocess.DEVNULL, capture_output=True
    )
    assert json.loads(worker.stdout.splitlines()[-1])["error"].startswith("The job folder")
    assert worker.returncode == 2


def test_runs_as_a_module(tmp_path):
    command = [sys.executable, "-m", "gskin_addon.core.worker.process", tmp_path / "none"]
    run = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True)
    assert run.returncode == 2
    assert "does not exist" in json.loads(run.stdout.splitlines()[-1])["error"]


def test_the_default_job_needs_numpy_only(tmp_path):
    folder = jobs.make_job(tmp_path / "job")
    bare = tmp_path / "modules"
    bare.mkdir()
    for name in ("numpy", "numpy.libs"):
        site = Path(np.__file__).parents[1] / name
        if site.exists():
            (bare / name).symlink_to(site, target_is_directory=True)
    run = subprocess.run(
        [sys.executable, "-S", PROGRAM, "--compute", folder],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": str(bare)},
    )
    assert run.returncode == 0, run.stderr
    assert contract.is_finished(folder)


def test_interpreter_without_torch(tmp_path):
    # -S hides what is installed; a path with links to all needed modules but torch shows the rest.
    folder = jobs.make_job(tmp_path / "job", guidance="elastic")
    bare = tmp_path / "modules"
    bare.mkdir()
    for name in ("numpy", "scipy", "numba", "llvmlite", "numpy.libs", "scipy.libs"):
        site = Path(np.__file__).parents[1] / name
        if site.exists():
            (bare / name).symlink_to(site, target_is_directory=True)
    run = subprocess.run(
        [sys.executable, "-S", PROGRAM, "--compute", folder],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": str(bare)},
    )
    last = json.loads(run.stdout.splitlines()[-1])
    assert run.returncode == last["exit_code"] == 2, run.stderr
    assert "lacks torch" in last["error"]
    assert "-m pip install torch" in last["error"]
    assert sys.executable in last["error"]


def test_numpy_loads_with_one_thread_unless_told_otherwise(tmp_path):
    code = textwrap.dedent(f"""
        import os, runpy, sys
        class Watch:
            def find_spec(self, name, path=None, target=None):
                if name == "numpy":
                    print(os.environ.get("OPENBLAS_NUM_THREADS"), file=sys.stderr)
        sys.meta_path.insert(0, Watch())
        module = runpy.run_path({str(PROGRAM)!r})
        module["main"](["--compute", {str(tmp_path / "none")!r}])
    """)
    for asked, expected in ((None, "1"), ("3", "3")):
        environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        environment |= {"OPENBLAS_NUM_THREADS": asked} if asked else {}
        run = subprocess.run(
            [sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True, text=True, env=environment
        )
        words = [line for line in run.stderr.splitlines() if line in ("None", "1", "3")]
        assert words
        assert words[-1] == expected


def test_interpreter_without_anything(tmp_path):
    run = subprocess.run(
        [sys.executable, "-S", PROGRAM, "--compute", tmp_path], stdin=subprocess.DEVNULL, capture_output=True
    )
    assert run.returncode == 2
    assert "lacks numpy" in json.loads(run.stdout)["error"]


def test_old_python_is_refused(monkeypatch, capfd):
    monkeypatch.setattr(process.sys, "version_info", (3, 9, 1, "final", 0))
    assert process.main(["job"]) == 2
    assert "Python 3.9.1" in json.loads(capfd.readouterr().out)["error"]
