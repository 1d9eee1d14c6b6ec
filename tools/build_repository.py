# SPDX-License-Identifier: GPL-3.0-or-later
"""Make a static extension repository: the archive, and the listing from which Blender installs and updates it.

.venv/bin/python tools/build_repository.py [--out dist/repository] [--tag v0.1.0]

The folder can be served by any web server, or read from disk: its address for Blender is that of index.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from build_zip import ROOT, build, run_tool


def main() -> int:
    """Build the archive and list it; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "dist" / "repository", help="folder of the repository")
    parser.add_argument("--tag", help="of a release: refused unless it is 'v' and the manifest's version")
    options = parser.parse_args()
    out = options.out.absolute()
    try:
        listing = build_repository(out)
    except subprocess.CalledProcessError as problem:
        return problem.returncode
    (entry,) = json.loads(listing.read_text())["data"]
    if options.tag is not None and options.tag != f"v{entry['version']}":
        print(f"The tag {options.tag} does not name the manifest's version {entry['version']}.", file=sys.stderr)
        return 2
    print(listing)
    return 0


def build_repository(out: Path) -> Path:
    """index.json of a repository in a folder; archives of earlier builds go: it lists the present version only.

    Raises:
        CalledProcessError: Blender's tool refused something; it has said why.
    """
    for old in out.glob("gskin_addon-*.zip"):
        old.unlink()
    build(out)
    run_tool("server-generate", "--repo-dir", str(out), "--html")
    return out / "index.json"


if __name__ == "__main__":
    sys.exit(main())
