# SPDX-License-Identifier: GPL-3.0-or-later
"""Files appear whole or not at all, follow no link, and have the permissions of any new file."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gskin_addon.core import files
from gskin_addon.core.errors import GSkinError
from gskin_addon.core.job.lock import job_lock

posix = pytest.mark.skipif(os.name != "posix", reason="links and umask of POSIX")


def write_bytes(path, data=b"new"):
    files.write_atomically(path, lambda file: file.write(data))


def write_by_path(path, data=b"new"):
    with files.replaced(path, ".blend") as temporary:
        temporary.write_bytes(data)


def write_anew(path, data=b"new"):
    """As Blender saves: another file is renamed over the temporary one."""
    with files.replaced(path, ".blend") as temporary:
        other = temporary.with_name(temporary.name + "@")
        other.write_bytes(data)
        os.replace(other, temporary)


WRITERS = [write_bytes, write_by_path, write_anew]


@contextmanager
def umask(value):
    before = os.umask(value)
    try:
        yield
    finally:
        os.umask(before)


@posix
@pytest.mark.parametrize("write", WRITERS)
def test_a_link_at_a_name_that_could_be_guessed_is_not_followed(tmp_path, write):
    victim = tmp_path / "victim"
    victim.write_bytes(b"dear")
    path = tmp_path / "job" / "report.json"
    path.parent.mkdir()
    guesses = [f".{path.name}.{os.getpid()}.tmp", f".{path.name}.{os.getpid()}", "report.tmp", f"{path.name}.tmp"]
    for name in [*guesses, path.name]:  # the last one: a link where the file itself shall be
        (path.parent / name).symlink_to(victim)
    write(path)
    assert victim.read_bytes() == b"dear"
    assert path.read_bytes() == b"new"
    assert not path.is_symlink()


@posix
def test_a_link_at_the_temporary_name_is_refused(tmp_path, monkeypatch):
    """Even one who could foresee the random name gets nothing written through a link."""
    victim = tmp_path / "victim"
    victim.write_bytes(b"dear")
    names = iter(["guessed", "other"])
    monkeypatch.setattr(files.secrets, "token_hex", lambda count: next(names))
    (tmp_path / ".gskin-guessed.tmp").symlink_to(victim)
    write_bytes(tmp_path / "out")
    assert victim.read_bytes() == b"dear"
    assert (tmp_path / "out").read_bytes() == b"new"

    def swap(temporary):
        temporary.unlink()
        temporary.symlink_to(victim)

    monkeypatch.undo()
    with pytest.raises(GSkinError), files.replaced(tmp_path / "swapped") as temporary:
        swap(temporary)
    assert not (tmp_path / "swapped").exists()


@posix
@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_permissions_are_those_of_a_new_file(tmp_path, write, mask):
    with umask(mask):
        write(tmp_path / "out")
        (tmp_path / "plain").write_bytes(b"")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("out", "plain")]
    assert modes[0] == modes[1] == 0o666 & ~mask


@pytest.mark.parametrize("by_path", [False, True])
@pytest.mark.parametrize("error", [ValueError, RuntimeError, KeyboardInterrupt])
def test_a_writer_that_fails_leaves_the_old_file_and_no_litter(tmp_path, by_path, error):
    path = tmp_path / "out"
    path.write_bytes(b"old")

    def fails(file):
        file.write(b"half")
        raise error("broken")

    def write():
        if by_path:
            with files.replaced(path) as temporary, open(temporary, "wb") as file:
                fails(file)
        else:
            files.write_atomically(path, fails)

    with pytest.raises(error, match="broken"):
        write()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("write", WRITERS)
def test_a_folder_that_is_not_there_is_named(tmp_path, write):
    with pytest.raises(GSkinError, match="nowhere"):
        write(tmp_path / "nowhere" / "out")


@posix
def test_a_full_disk_is_told_whatever_library_writes(tmp_path):
    # The limit on file sizes stops a write in its middle, as a full disk does; it binds one whole process.
    code = (
        "import resource, sys, pathlib, torch\n"
        "from gskin_addon.core import checkpoint, errors\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))\n"
        "try: checkpoint.save_checkpoint(pathlib.Path(sys.argv[1]), {'a': torch.ones(5000)})\n"
        "except errors.GSkinError as error: print(error)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "state")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "disk is full" in run.stdout, run.stderr
    assert not list(tmp_path.iterdir())


def test_leftovers_of_killed_writers_are_removed(tmp_path):
    (tmp_path / ".gskin-0123.tmp").write_bytes(b"half")
    (tmp_path / "state").write_bytes(b"whole")
    files.remove_leftovers(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["state"]


@posix
def test_a_linked_lock_file_does_not_empty_what_it_leads_to(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("dear")
    (tmp_path / "worker.lock").symlink_to(victim)
    with pytest.raises(GSkinError, match=r"worker\.lock"), job_lock(tmp_path / "worker.lock"):
        pass
    assert victim.read_text() == "dear"


@given(name=st.text(max_size=20))
@settings(max_examples=200, deadline=None)
def test_plain_names_stay_in_their_folder(tmp_path_factory, name):
    folder = tmp_path_factory.getbasetemp()
    if files.is_plain_name(name):
        assert (folder / name).parent == folder
        assert os.path.dirname(os.path.normpath(folder / name)) == str(folder)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../a", "a/b", "a\\b", "/a", "C:a", "a\0b", ".hidden", "a ", "x" * 300]
)
def test_paths_are_no_plain_names(name):
    assert not files.is_plain_name(name)


def test_arrays_are_read_by_name(tmp_path):
    path = tmp_path / "a.npz"
    files.write_arrays(path, {"a": np.arange(3), "b": np.eye(2)})
    assert set(files.read_arrays(path)) == {"a", "b"}
    assert set(files.read_arrays(path, ["b"], ["c"])) == {"b"}
    with pytest.raises(ValueError, match="lacks the array c"):
        files.read_arrays(path, ["a", "c"])
    with pytest.raises(FileNotFoundError):
        files.read_arrays(tmp_path / "none.npz")
    np.save(tmp_path / "one.npy", np.arange(3))
    np.savez_compressed(tmp_path / "z.npz", a=np.arange(1000))
    packed = bytearray((tmp_path / "z.npz").read_bytes())
    packed[60:90] = bytes(30)
    (tmp_path / "z.npz").write_bytes(packed)
    for name in ("one.npy", "z.npz"):
        with pytest.raises(ValueError, match=r"\w"):
            files.read_arrays(tmp_path / name)
