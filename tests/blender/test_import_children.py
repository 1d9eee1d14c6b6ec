# SPDX-License-Identifier: GPL-3.0-or-later
"""Blenders that import one file each, also those that fall over or never end."""

from __future__ import annotations

import json
import os
import stat
import time
from argparse import Namespace

import pytest

from gskin_addon.commands import import_rigged
from gskin_addon.core.errors import InputError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the false Blender is a shell script")


@pytest.fixture
def options(tmp_path):
    files = []
    for name in ("ends", "hangs", "lies"):
        files.append(tmp_path / f"{name}.glb")
        files[-1].write_text(name)
    blender = tmp_path / "blender"
    blender.write_text(
        "#!/bin/sh\n"
        'case "$*" in\n'
        "*ends.glb*) echo 'the last words'; exit 11;;\n"
        "*hangs.glb*) exec sleep 60;;\n"
        '*) for word in "$@"; do [ "$last" = --into ] && into="$word"; last="$word"; done\n'
        '  echo \'{"facts": {"family": "f"}}\' > "$into/result.json";;\n'
        "esac\n"
    )
    blender.chmod(blender.stat().st_mode | stat.S_IXUSR)
    return Namespace(
        files=files, out=tmp_path / "out", into=None, blender=blender, jobs=3, minutes=0.02, licence="CC0", author="",
        family="",
    )  # fmt: skip


def test_a_file_that_takes_blender_down_or_for_ever_costs_only_itself(options, tmp_path):
    told, begun = [], time.monotonic()
    with pytest.raises(InputError, match="None of the 3 files could be imported; the reasons stand in"):
        import_rigged.run(options, lambda done, words: told.append(done))
    assert time.monotonic() - begun < 40  # nobody waited for the one that hangs
    failed = json.loads((options.out / "catalog.json").read_text())["failed"]
    reasons = {entry["file"]: entry["reason"] for entry in failed}
    assert "Blender ended with code 11 (the last words)" in reasons["ends.glb"]
    assert "longer than --minutes allows" in reasons["hangs.glb"]
    assert reasons["lies.glb"] == "its arrays are gone"
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_stop_ends_the_blenders(options):
    options.minutes, options.files = 5, [options.files[1]]
    started = []

    def remember(*args, **kwargs):
        started.append(real(*args, **kwargs))
        return started[-1]

    def stop(seconds):
        raise KeyboardInterrupt

    real = import_rigged.subprocess.Popen
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_rigged.subprocess, "Popen", remember)
        patch.setattr(import_rigged.time, "sleep", stop)
        with pytest.raises(KeyboardInterrupt):
            import_rigged.run(options, lambda *_: None)
    (process,) = started
    assert process.poll() is not None


def test_a_blender_that_is_none_is_named(options, tmp_path):
    options.blender = tmp_path / "nothing"
    with pytest.raises(InputError, match=r"nothing' is no program that can be started; give the path of Blender"):
        import_rigged.run(options, lambda *_: None)
