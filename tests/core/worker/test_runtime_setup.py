# SPDX-License-Identifier: GPL-3.0-or-later
"""The learning runtime: made, cancelled, gone on with, repaired, removed. Real environments, packages of a fake pip."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from gskin_addon import cli
from gskin_addon.commands import runtime as command
from gskin_addon.core.errors import Cancelled, GSkinError, InputError
from gskin_addon.core.worker import interpreter, runtime_client, runtime_install, runtime_tools
from gskin_addon.core.worker import runtime_folder as folders
from gskin_addon.core.worker.runtime_choice import (
    BACKENDS,
    INDEX_VARIABLE,
    MIRROR,
    PIP,
    PYTORCH,
    TORCH,
    WHEELS,
    Choice,
    Source,
    find_backend,
    guess_backend,
    parse_source,
)
from gskin_addon.core.worker.runtime_client import PROGRAM, RuntimeClient
from gskin_addon.core.worker.runtime_packages import damaged_packages

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the fake pip knows the layout of POSIX")

FAKE = Path(__file__).resolve().parents[2] / "helpers" / "fake_runtime_setup.py"
CPU = Choice(BACKENDS["cpu"])
ALL = ["torch", "numba", "scipy", "safetensors", "pillow", "diffusers", "transformers", "accelerate", "peft", "numpy"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A place with a space and an umlaut; the fake pip notes what it makes."""
    monkeypatch.setenv("GSKIN_FAKE_CALLS", str(tmp_path / "calls"))
    monkeypatch.delenv("GSKIN_FAKE_PIP", raising=False)
    monkeypatch.delenv(folders.VARIABLE, raising=False)
    return tmp_path / "my häuser" / "runtime"


def client_for(folder, action="install", choice=CPU) -> RuntimeClient:
    return RuntimeClient(action, folder, choice, sys.executable, FAKE)


def run(folder, action="install", choice=CPU) -> list:
    """Run to the end; the events."""
    client, seen = client_for(folder, action, choice), []
    client.start()
    client.wait(seen.append)
    return seen


def calls(folder) -> list[str]:
    """The packages made since the last question."""
    path = folder.parents[1] / "calls"
    names = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return names


def packages(folder) -> Path:
    found = folders.packages_in(folder)
    assert found is not None
    return found


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


# --- installing


def test_installs_tells_and_is_found(folder, monkeypatch):
    assert folders.look(folder).state == "missing"
    seen = run(folder)
    assert [*dict.fromkeys(event.stage for event in seen)] == [
        "prepare", "environment", "torch", "packages", "check"
    ]  # fmt: skip
    fractions = [event.fraction for event in seen]
    assert fractions == sorted(fractions)
    assert calls(folder) == ALL
    status = folders.look(folder)
    assert status.state == "ready"
    assert "torch 2.13.0 (Processor)" in status.sentence
    assert set(status.manifest["packages"]) == set(ALL)
    assert not (folder / folders.SCRATCH).exists()
    assert "Collecting torch" in (folder / folders.LOG).read_text()

    for name in (interpreter.VARIABLE, "VIRTUAL_ENV"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(folders.VARIABLE, str(folder))
    assert interpreter.find_worker_python() == status.python
    assert interpreter.find_worker_python(sys.executable) == Path(sys.executable)
    monkeypatch.setenv(interpreter.VARIABLE, sys.executable)
    assert interpreter.find_worker_python() == Path(sys.executable)


def test_what_is_there_is_kept(folder):
    run(folder)
    calls(folder)
    run(folder)
    assert calls(folder) == []


def test_without_diffusion_and_with_it_later(folder):
    run(folder, choice=Choice(BACKENDS["cpu"], diffusion=False))
    assert "diffusers" not in calls(folder)
    run(folder)
    assert calls(folder) == ["diffusers", "transformers", "accelerate", "peft"]


@pytest.mark.skipif(sys.platform != "linux", reason="two backends on one system")
def test_another_backend_is_made_anew(folder):
    run(folder)
    calls(folder)
    run(folder, choice=Choice(BACKENDS["cuda"]))
    assert set(calls(folder)) == {*ALL, "warp-lang"}
    assert folders.look(folder).manifest["backend"] == "cuda"


@pytest.mark.parametrize("at", ["torch", "diffusers"])
def test_cancel_is_quick_leaves_nothing_running_and_the_next_run_goes_on(folder, monkeypatch, at):
    monkeypatch.setenv("GSKIN_FAKE_PIP", f"hang:{at}")
    client = client_for(folder)
    client.start()
    until = time.monotonic() + 60
    while "hanging" not in client.log:
        client.poll()
        assert client.state == "running", client.sentence
        assert time.monotonic() < until
        time.sleep(0.02)
    assert folders.look(folder).state == "installing"
    pids = [int(text) for text in (folder.parents[1] / "calls.pids").read_text().split()]
    begun = time.monotonic()
    client.cancel()
    with pytest.raises(Cancelled, match="goes on"):
        client.wait()
    assert time.monotonic() - begun < 1.0
    while not all(map(gone, pids)):
        assert time.monotonic() - begun < 1.0, "pip or its child lives on"
        time.sleep(0.02)
    status = folders.look(folder)
    assert (status.state, status.usable) == ("broken", False)
    assert "install it again to go on" in status.problem

    before = calls(folder)
    monkeypatch.delenv("GSKIN_FAKE_PIP")
    run(folder)
    assert folders.look(folder).state == "ready"
    # METADATA of the interrupted one lay there without a RECORD: it is made again, the finished ones are not.
    assert at not in before
    assert calls(folder) == [name for name in ALL if name not in before]


def test_it_ends_with_the_one_who_started_it(folder, monkeypatch):
    monkeypatch.setenv("GSKIN_FAKE_PIP", "hang:torch")
    client = client_for(folder)
    client.start()
    while "hanging" not in client.log:
        client.poll()
        time.sleep(0.02)
    client._process.stdin.close()  # what the system does when Blender is gone
    begun = time.monotonic()
    with pytest.raises(Cancelled):
        client.wait()
    assert time.monotonic() - begun < 1.0


def test_two_at_once(folder, monkeypatch):
    monkeypatch.setenv("GSKIN_FAKE_PIP", "hang:torch")
    first = client_for(folder)
    first.start()
    while "hanging" not in first.log:
        first.poll()
        time.sleep(0.02)
    with pytest.raises(InputError, match="being installed by another process"):
        run(folder)
    with pytest.raises(InputError, match="being installed by another process"):
        folders.remove(folder)
    first.cancel()
    with pytest.raises(Cancelled):
        first.wait()
    folders.remove(folder)
    assert not folder.exists()


def test_what_does_not_import_is_not_ready(folder, monkeypatch):
    monkeypatch.setenv("GSKIN_FAKE_PIP", "broken:numba")
    with pytest.raises(GSkinError, match=r"numba of .* does not load.*half a wheel"):
        run(folder)
    assert folders.look(folder).state == "broken"
    assert folders.ready_python(folder) is None


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "disk is full"),
        ("WARNING: Retrying ... NewConnectionError\nERROR: No matching distribution found for torch", "be reached"),
        ("error: Failed to fetch: dns error: failed to lookup address", "be reached"),
        ("SSLError(SSLCertVerificationError CERTIFICATE_VERIFY_FAILED)", "certificate"),
        ("ERROR: Wheel 'numba' located at /w/numba-0.60-cp311.whl is invalid.", "numba-0.60-cp311.whl' is damaged"),
        ("ERROR: No matching distribution found for torch==2.13.0", "has no torch==2.13.0 for Python"),
        ("ERROR: Could not install: [Errno 13] Permission denied: 'x'", "permissions"),
        ("ERROR: something new", "something new"),
    ],
)
def test_failures_of_pip_are_one_sentence_with_a_remedy(folder, monkeypatch, said, words):
    monkeypatch.setenv("GSKIN_FAKE_PIP", f"fail:{said}")
    with pytest.raises(GSkinError, match=words) as caught:
        run(folder)
    assert "\n" not in str(caught.value)
    assert not folders.look(folder).usable


# --- folders that will not do


def test_no_room_is_seen_first(folder, monkeypatch):
    monkeypatch.setattr(runtime_install.shutil, "disk_usage", lambda path: SimpleNamespace(free=300e6))
    sent: list[dict] = []
    setup = runtime_install.Setup(folder, CPU, runtime_tools.find_tools, sent.append, None)
    with pytest.raises(InputError, match=r"needs 1\.\d GB.*has 0\.3 GB free.*another folder"):
        setup.run()
    assert not folder.exists()


def test_folders_of_others_are_left_alone(folder, tmp_path):
    folder.mkdir(parents=True)
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds other files"):
        run(folder)
    with pytest.raises(InputError, match="nothing was deleted"):
        folders.remove(folder)
    (folder / folders.MANIFEST).write_text('{"program": "another"}')
    with pytest.raises(InputError, match="holds other files"):
        run(folder)
    with pytest.raises(InputError, match="nothing was deleted"):
        folders.remove(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["runtime.json", "thesis.tex"]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        run(tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written"):
        run(tmp_path / "file" / "below")


def test_remove_takes_what_is_ours_and_follows_no_link(folder, tmp_path):
    run(folder)
    elsewhere = tmp_path / "elsewhere"
    shutil.move(folder / folders.ENVIRONMENT, elsewhere)
    (folder / folders.ENVIRONMENT).symlink_to(elsewhere)
    (folder / "note.txt").write_text("mine")
    folders.remove(folder)
    assert [path.name for path in folder.iterdir()] == ["note.txt"]
    assert (elsewhere / "pyvenv.cfg").is_file()


# --- damage


def test_repair_brings_back_lost_and_altered_files(folder):
    run(folder)
    calls(folder)
    (packages(folder) / "numba" / "__init__.py").unlink()
    (packages(folder) / "scipy" / "data.bin").write_bytes(b"9876543210" * 50)  # as long as before
    (packages(folder) / "torch" / "data.bin").write_bytes(b"cut")
    status = folders.look(folder)
    assert status.state == "broken"
    assert "numba is gone" in status.problem
    assert set(damaged_packages(packages(folder))) == {"numba", "torch"}
    run(folder, "repair")
    assert sorted(calls(folder)) == ["numba", "scipy", "torch"]
    assert folders.look(folder).state == "ready"
    assert damaged_packages(packages(folder), deep=True) == {}


def test_the_python_below_may_go_and_packages_stay(folder):
    run(folder)
    calls(folder)
    for link in (folder / folders.ENVIRONMENT / "bin").glob("python*"):
        link.unlink()
    python = folders.python_in(folder)
    python.symlink_to(folder / "removed with the old Blender")
    assert "Python that it was made with is gone" in folders.look(folder).problem
    run(folder, "repair")
    assert folders.look(folder).state == "ready"
    assert calls(folder) == []


@pytest.mark.parametrize("text", ["", "{", "[1]", "\xff"])
def test_a_damaged_manifest_is_broken_and_mends(folder, text):
    run(folder)
    calls(folder)
    (folder / folders.MANIFEST).write_bytes(text.encode("latin-1"))
    assert folders.look(folder).state == "broken"
    with pytest.raises(InputError, match="nothing was deleted"):
        folders.remove(folder)
    run(folder, "repair")
    assert folders.look(folder).state == "ready"
    assert calls(folder) == []


def test_another_recipe_is_outdated_but_works(folder):
    run(folder)
    manifest = json.loads((folder / folders.MANIFEST).read_text())
    (folder / folders.MANIFEST).write_text(json.dumps({**manifest, "recipe": "old"}))
    status = folders.look(folder)
    assert (status.state, status.usable) == ("outdated", True)
    run(folder)
    assert folders.look(folder).state == "ready"


# --- choices


def test_sources(tmp_path, monkeypatch):
    cpu = BACKENDS["cpu"]
    monkeypatch.delenv(INDEX_VARIABLE, raising=False)
    assert parse_source() == Source(PYTORCH)
    assert Source(PYTORCH).flags(cpu, torch=True) == [f"--index-url={cpu.index}"]
    assert Source(PYTORCH).flags(cpu, torch=False) == []
    assert Source(PIP).flags(cpu, torch=True) == []
    monkeypatch.setenv(INDEX_VARIABLE, "https://me:secret@mirror.example/simple")
    mirror = parse_source()
    assert mirror.flags(cpu, torch=False) == ["--index-url=https://me:secret@mirror.example/simple"]
    assert "secret" not in mirror.sentence
    monkeypatch.setenv(INDEX_VARIABLE, "pip")
    assert parse_source() == Source(PIP)
    for text in ("", "mirror.example", "--trusted-host=evil", "https://a b"):
        with pytest.raises(InputError, match="no address"):
            parse_source(MIRROR, text)
    wheels = tmp_path / "whe els"
    with pytest.raises(InputError, match="does not exist"):
        parse_source(WHEELS, str(wheels))
    wheels.mkdir()
    with pytest.raises(InputError, match=r"no \.whl"):
        parse_source(WHEELS, str(wheels))
    (wheels / "torch-2.13.0-py3-none-any.whl").write_bytes(b"")
    source = parse_source(WHEELS, str(wheels))
    assert source.flags(cpu, torch=True) == ["--no-index", f"--find-links={wheels}"]
    assert not source.needs_network


def test_backends(monkeypatch):
    def no_driver(name):
        raise OSError(name)

    for system, opens, kfd, expected in (
        ("linux", lambda name: name == "libcuda.so.1", False, "cuda"),
        ("win32", lambda name: name == "nvcuda.dll", False, "cuda"),
        ("linux", no_driver, True, "rocm"),
        ("linux", no_driver, False, "cpu"),
        ("win32", no_driver, True, "cpu"),
        ("darwin", no_driver, False, "apple"),
    ):
        assert guess_backend(system, opens, lambda path, kfd=kfd: kfd) == expected
    with pytest.raises(InputError, match="no backend 'tpu'"):
        find_backend("tpu")
    if sys.platform == "linux":
        with pytest.raises(InputError, match="does not exist for Linux"):
            find_backend("apple")


def test_every_package_has_a_licence_and_a_size():
    for backend in BACKENDS.values():
        choice = Choice(backend)
        assert choice.download > 100
        assert choice.disk > choice.download / 2
        for name in choice.names:
            assert any(name in line for line in choice.licences)
    assert any("BSD-3-Clause: torch" in line for line in CPU.licences)


def test_the_default_folder_carries_no_version_of_blender(monkeypatch, tmp_path):
    monkeypatch.delenv(folders.VARIABLE, raising=False)
    home = Path(tmp_path)
    monkeypatch.setenv("HOME", str(home))
    for system, variable, expected in (
        ("linux", "XDG_DATA_HOME", home / "data" / "gskin" / "runtime"),
        ("linux", "", home / ".local" / "share" / "gskin" / "runtime"),
        ("darwin", "", home / "Library" / "Application Support" / "gskin" / "runtime"),
        ("win32", "LOCALAPPDATA", home / "data" / "gskin" / "runtime"),
    ):
        monkeypatch.delenv("XDG_DATA_HOME", raising=False)
        if variable:
            monkeypatch.setenv(variable, str(home / "data"))
        monkeypatch.setattr(folders.sys, "platform", system)
        assert folders.runtime_folder() == expected
    monkeypatch.undo()
    assert folders.runtime_folder(str(tmp_path)) == tmp_path
    monkeypatch.setenv(folders.VARIABLE, str(tmp_path / "named"))
    assert folders.runtime_folder(str(tmp_path)) == tmp_path / "named"


# --- tools


def test_uv_comes_first_but_not_for_pips_own_settings(monkeypatch, tmp_path):
    uv = tmp_path / "uv"
    uv.write_text("#!/bin/sh\n")
    uv.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert runtime_tools.find_tools(CPU).make(Path("env"))[:2] == [str(uv), "venv"]
    assert runtime_tools.find_tools(Choice(CPU.backend, True, Source(PIP))).name == "pip"
    monkeypatch.chdir(tmp_path)  # where an opened file may lie beside anything
    assert runtime_tools.find_tools(CPU).name == "pip"
    for tool in (runtime_tools.find_tools(CPU),):
        assert "--only-binary=:all:" in tool.install(Path("python"))
        assert "-I" in tool.install(Path("python"))


def test_a_python_without_venv_is_a_sentence(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(runtime_tools.importlib.util, "find_spec", lambda name: None if name == "ensurepip" else 1)
    with pytest.raises(InputError, match=r"apt install python3-venv.*or uv"):
        runtime_tools.find_tools(CPU)


def test_pythons_without_torch_are_refused(monkeypatch, folder):
    monkeypatch.setattr(runtime_install.sys, "version_info", (3, 19, 0))
    setup = runtime_install.Setup(folder, CPU, runtime_tools.find_tools, lambda line: None, None)
    with pytest.raises(InputError, match=r"is Python 3\.19.*3\.11 to 3\.14"):
        setup.run()


def test_pip_installs_where_it_is_told(monkeypatch, tmp_path):
    monkeypatch.setenv("PIP_TARGET", "/somewhere/else")
    monkeypatch.setenv("PIP_USER", "1")
    monkeypatch.setenv("PYTHONPATH", "/blender")
    environment = runtime_install._environment(tmp_path)
    assert "PIP_TARGET" not in environment
    assert "PYTHONPATH" not in environment
    assert environment["PIP_USER"] == "0"
    assert environment["TMPDIR"] == str(tmp_path / "tmp")


def test_the_program_starts_alone_and_isolated(tmp_path):
    """As Blender starts it: by its path, with -I, from anywhere; the extension's folder may have any name."""
    command = [sys.executable, "-I", "-u", str(PROGRAM), "install", f"--folder={tmp_path / 'r'}", "--backend", "tpu"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    last = json.loads(done.stdout.splitlines()[-1])
    assert "no backend 'tpu'" in last["error"]
    assert not (tmp_path / "r").exists()


def test_a_python_without_numpy_says_so(tmp_path):
    command = [sys.executable, "-I", "-S", str(PROGRAM), "install", f"--folder={tmp_path / 'r'}", "--backend", "cpu"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "lacks numpy" in json.loads(done.stdout)["error"]


def test_the_base_is_a_python_and_not_blender(monkeypatch):
    assert runtime_client.base_python() == sys.executable
    monkeypatch.setattr(sys, "executable", "/opt/blender/blender")
    assert "python" in Path(runtime_client.base_python()).name
    client = RuntimeClient("install", Path("x"), CPU, "/no/python")
    with pytest.raises(InputError, match="cannot be started"):
        client.start()


# --- the command line


def test_commands(folder, monkeypatch, capsys):
    monkeypatch.setattr(command, "RuntimeClient", lambda *a: RuntimeClient(*a[:3], sys.executable, FAKE))
    where = ["--folder", str(folder)]
    assert cli.main(["runtime", "status", *where]) == 2
    assert cli.main(["runtime", "repair", *where]) == 2
    monkeypatch.setattr(command, "sys", SimpleNamespace(modules={"bpy": SimpleNamespace(app=_Offline)}))
    assert cli.main(["runtime", "install", *where, "--backend", "cpu"]) == 2
    assert "online access is off" in capsys.readouterr().err
    monkeypatch.setattr(command, "sys", SimpleNamespace(modules={}))
    assert cli.main(["runtime", "install", *where, "--backend", "cpu", "--no-diffusion"]) == 0
    said = capsys.readouterr().err
    assert "GB to fetch" in said
    assert "BSD-3-Clause: torch" in said
    assert "is ready: torch 2.13.0" in said
    (packages(folder) / "torch" / "__init__.py").unlink()
    assert cli.main(["runtime", "status", *where]) == 2
    assert cli.main(["runtime", "repair", *where]) == 0
    assert folders.look(folder).manifest["diffusion"] is False
    assert cli.main(["runtime", "status", *where]) == 0
    assert cli.main(["runtime", "remove", *where]) == 2
    assert folder.exists()
    assert cli.main(["runtime", "remove", *where, "--yes"]) == 0
    assert not folder.exists()


class _Offline:
    online_access = False


def test_requirements_are_fixed_here(folder, monkeypatch):
    """What pip is asked for is known beforehand, whatever the surroundings say."""
    seen = []
    children = SimpleNamespace(run=lambda command, environment, hear: seen.append(command) or 1)
    monkeypatch.setenv("PIP_REQUIREMENT", "evil.txt")
    setup = runtime_install.Setup(folder, CPU, runtime_tools.find_tools, lambda line: None, children)
    monkeypatch.setattr(setup, "_make_environment", lambda tools: None)
    monkeypatch.setattr(setup, "_drop_damaged", lambda: None)
    with pytest.raises(GSkinError):
        setup.run()
    assert seen[0][-1] == TORCH
    assert "PIP_REQUIREMENT" not in runtime_install._environment(folder)
