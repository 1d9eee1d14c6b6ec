# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the extension archive with Blender's own extension tool and let the same tool validate it.

.venv/bin/python tools/build_zip.py [--out dist]

Pages of docs/ go along as the manual. Where $SITE_URL says where the documentation is published, as for `make docs`,
the manifest gets it as the extension's website, and the manual's entry in menus leads there.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from manual_pages import write_pages

ROOT = Path(__file__).resolve().parents[1]


def extension_tool() -> Path:
    """Blender's `blender_ext.py`, which ships inside the bpy wheel and runs under plain Python."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        raise SystemExit("The bpy module is not installed in this Python: run `make venv` first.")
    package = Path(spec.origin).parent
    found = sorted(package.rglob("addons_core/bl_pkg/cli/blender_ext.py"))
    if not found:
        raise SystemExit(f"Blender's extension tool is not in {package}: install bpy 5.0 or newer.")
    return found[-1]


def main() -> int:
    """Build and validate; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the archive")
    try:
        print(build(parser.parse_args().out))
    except subprocess.CalledProcessError as problem:
        return problem.returncode
    return 0


def build(out: Path) -> Path:
    """The archive, made in a folder and validated.

    Raises:
        CalledProcessError: Blender's tool refused the source or the archive; it has said why.
    """
    out = out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    manifest = tomllib.loads((ROOT / "gskin_addon" / "blender_manifest.toml").read_text())
    archive = out / f"{manifest['id']}-{manifest['version']}.zip"
    with tempfile.TemporaryDirectory() as scratch:
        # A clean copy keeps caches and editor droppings out; the licence travels with the code.
        source = Path(scratch) / "gskin_addon"
        shutil.copytree(
            ROOT / "gskin_addon", source, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", ".*")
        )
        shutil.copy2(ROOT / "LICENSE", source / "LICENSE")
        write_pages(ROOT / "docs", source / "manual")
        site = os.environ.get("SITE_URL", "")
        if site:
            text = (source / "blender_manifest.toml").read_text(encoding="utf-8")
            line = f"website = {json.dumps(site)}\n"  # before the first table
            (source / "blender_manifest.toml").write_text(text.replace("\n[", f"\n{line}\n[", 1), encoding="utf-8")
        run_tool("validate", str(source))
        run_tool("build", "--source-dir", str(source), "--output-filepath", str(archive))
    run_tool("validate", str(archive))
    return archive


def run_tool(*words: str) -> None:
    """Blender's extension tool with these words; its own words go to stderr."""
    subprocess.run([sys.executable, str(extension_tool()), *words], check=True, stdout=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
