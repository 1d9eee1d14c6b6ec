# SPDX-License-Identifier: GPL-3.0-or-later
"""A real Blender gets the extension from the static repository, as a person who added its address does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from blenders import ROOT, Blender
from judging import Check

NAME = "gskin"
"""Of the repository in Blender's preferences."""


def check_repository(blender: Blender, out: Path, timeout: float) -> Check:
    """Make the repository, add it by address, sync, install, and see the add-on on in a new Blender."""
    tool = [sys.executable, str(ROOT / "tools/build_repository.py"), "--out", str(out / "repository")]
    subprocess.check_call(tool, stdout=sys.stderr)
    user = out / "user-of-repository"
    user.mkdir()
    address = (out / "repository" / "index.json").as_uri()
    on = f"import bpy; assert 'bl_ext.{NAME}.gskin_addon' in bpy.context.preferences.addons"
    for words in (
        ["--command", "extension", "repo-add", "--url", address, "--name", "GSkin", NAME],
        ["--online-mode", "--command", "extension", "sync"],
        ["--online-mode", "--command", "extension", "install", "--sync", "--enable", "gskin_addon"],
        ["-b", "--python-exit-code", "1", "--python-expr", on],
    ):
        if blender.run([blender.program, *words], {"BLENDER_USER_RESOURCES": str(user)}, timeout) != 0:
            return ("Blender installs from the repository", False, " ".join(words))
    return ("Blender installs from the repository", True, address)
