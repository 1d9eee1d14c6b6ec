# SPDX-License-Identifier: GPL-3.0-or-later
"""Programs of npm as oracles: installed below build/ where npm can, else the test is skipped."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

BUILD = Path(__file__).resolve().parents[2] / "build"


def npm_folder(name: str, package: str) -> Path:
    """A folder whose node_modules holds `package` ("scope/name@version"); build/`name` may also link to one."""
    folder = BUILD / name
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("no node and npm")
    bare = package[: package.rindex("@")]
    if not (folder / "node_modules" / bare / "package.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "package.json").write_text("{}")
        command = ["npm", "install", "--no-audit", "--no-fund", package]
        try:
            result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip(f"npm has not installed {package} within two minutes")
        if result.returncode != 0:
            pytest.skip(f"npm cannot install {package}: {result.stderr.strip()[-200:]}")
    return folder
