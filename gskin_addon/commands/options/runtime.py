# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin runtime`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core.worker.runtime_choice import BACKENDS as TORCH_BACKENDS
from .shared import Parser, common, progress


def add(commands: Any) -> None:
    """Add `gskin runtime` to the commands."""
    runtime = commands.add_parser(
        "runtime",
        help="install the Python with torch that guidance needs",
        description="Install, look at, repair or remove the learning runtime (docs/install.md). Stopped, the same "
        "command goes on where it was.",
        allow_abbrev=False,
    )
    actions = runtime.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    tips = {
        "install": "make it, complete it or bring it up to date",
        "status": "say how it is; exit code 2 where none works",
        "repair": "compare every file with what was installed, and fetch again what is not whole",
        "remove": "delete it",
    }
    for name, tip in tips.items():
        action = actions.add_parser(name, help=tip, description=tip[:1].upper() + tip[1:] + ".", allow_abbrev=False)
        action.add_argument("--folder", type=Path, metavar="F", help="its folder (default: $GSKIN_RUNTIME, or yours)")
        if name in ("install", "repair"):
            action.add_argument(
                "--backend",
                default="auto",
                choices=("auto", *TORCH_BACKENDS),
                help="what torch computes on (default: as the drivers say)",
            )
            action.add_argument(
                "--no-diffusion", dest="diffusion", action="store_false", help="without what diffusion guidances need"
            )
            source = action.add_mutually_exclusive_group()
            source.add_argument("--index", default="", metavar="URL", help="an index, or pip: as pip is set up")
            source.add_argument("--wheels", type=Path, metavar="FOLDER", help="a folder of wheels, without network")
            action.add_argument("--base", metavar="PYTHON", help="the Python to build on (default: this one)")
            progress(action)
        if name == "remove":
            action.add_argument("--yes", action="store_true", help="really")
        common(action)
