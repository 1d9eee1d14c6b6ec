# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the extension archive with Blender's own extension tool and let the same tool validate it.

.venv/bin/python tools/build_zip.py [--out dist]
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

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
    out = parser.parse_args().out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    tool = [sys.executable, str(extension_tool())]
    with tempfile.TemporaryDirectory() as scratch:
        # A clean copy keeps caches and editor droppings out; the licence travels with the code.
        source = Path(scratch) / "gskin_addon"
        shutil.copytree(
            ROOT / "gskin_addon", source, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", ".*")
        )
        shutil.copy2(ROOT / "LICENSE", source / "LICENSE")
        for arguments in (
            ["validate", str(source)],
            ["build", "--source-dir", str(source), "--output-dir", str(out)],
        ):
            if code := subprocess.call([*tool, *arguments]):
                return code
    archives = sorted(out.glob("gskin_addon-*.zip"), key=lambda path: path.stat().st_mtime)
    if not archives:
        print(f"No archive appeared in {out}; the lines above say why.", file=sys.stderr)
        return 1
    if code := subprocess.call([*tool, "validate", str(archives[-1])]):
        return code
    print(archives[-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
