# SPDX-License-Identifier: GPL-3.0-or-later
"""The static extension repository, made and read by the extension tool of this version of Blender."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "tools"
MANIFEST = tomllib.loads((ROOT / "gskin_addon" / "blender_manifest.toml").read_text())


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def repository(tmp_path_factory):
    """The folder that `make repository` makes."""
    out = tmp_path_factory.mktemp("repository")
    (out / "gskin_addon-0.0.1.zip").write_bytes(b"an earlier build")
    done = run(TOOLS / "build_repository.py", "--out", out, "--tag", f"v{MANIFEST['version']}")
    assert done.returncode == 0, done.stderr
    return out


def test_the_listing_names_our_archive(repository):
    (entry,) = json.loads((repository / "index.json").read_text())["data"]
    archive = repository / entry["archive_url"]
    assert archive.name == f"{MANIFEST['id']}-{MANIFEST['version']}.zip"
    content = archive.read_bytes()
    assert entry["archive_hash"] == "sha256:" + hashlib.sha256(content).hexdigest()
    assert entry["archive_size"] == len(content)
    for name in ("id", "version", "name", "tagline", "license", "blender_version_min", "permissions", "tags"):
        assert entry[name] == MANIFEST[name]
    assert archive.name in (repository / "index.html").read_text()
    assert [path.name for path in repository.glob("*.zip")] == [archive.name]


def test_the_archive_has_the_code_the_licence_and_no_droppings(repository):
    (archive,) = repository.glob("*.zip")
    names = {name.removeprefix("gskin_addon/") for name in zipfile.ZipFile(archive).namelist()}
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "core/worker/process.py"} <= names
    assert any(name.endswith(".safetensors") for name in names)
    assert not [name for name in names if "__pycache__" in name or name.startswith((".", "tests"))]


def test_blender_installs_from_it(repository, tmp_path):
    """By address, as a person who added the repository does: the code behind Preferences > Get Extensions."""
    sys.path.insert(0, str(TOOLS))
    try:
        from build_zip import extension_tool
    finally:
        sys.path.remove(str(TOOLS))
    local = tmp_path / "local"
    local.mkdir()
    where = ["--local-dir", local, "--remote-url", (repository / "index.json").as_uri()]
    version = ["--blender-version", bpy.app.version_string.split()[0]]
    python = ["--python-version", "{}.{}.{}".format(*sys.version_info)]
    done = run(extension_tool(), "sync", *where)
    assert done.returncode == 0, done.stdout + done.stderr
    done = run(extension_tool(), "install", *where, *version, *python, MANIFEST["id"])
    assert done.returncode == 0, done.stdout + done.stderr
    installed = tomllib.loads((local / MANIFEST["id"] / "blender_manifest.toml").read_text())
    assert installed == MANIFEST


def test_a_tag_of_another_version_is_refused(tmp_path):
    done = run(TOOLS / "build_repository.py", "--out", tmp_path, "--tag", "v99.0.0")
    assert done.returncode == 2
    assert "v99.0.0" in done.stderr
