# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin train-guidance import`: rigged models of any file as assets to train on, each read by a Blender of its own.

A file that takes Blender down, or for ever, costs only itself: it is listed among the failures.
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
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import GSkinError, InputError
from ..core.files import write_json
from ..core.training.collection import Collection, Wanted, npz_path, wanted_files, write_asset
from .blender import require_bpy
from .console import print_message

SUFFIXES = (".glb", ".gltf", ".vrm", ".fbx", ".blend")
PROGRAM = Path(__file__).resolve().parents[1] / "cli.py"
_PAUSE = 0.05

Report = Callable[[float, str], None]


def run(options: argparse.Namespace, report: Report) -> str:
    """Import all files; returns a sentence on how it went. Raises InputError where none could be imported."""
    if options.into is not None:
        _import_here(options)
        return ""
    collection = Collection(options.out)
    wanted = wanted_files(options.files, SUFFIXES, collection)
    blender = _blender(options.blender)
    todo = [file for file in wanted if not collection.has(file)]
    options.out.mkdir(parents=True, exist_ok=True)
    failed: dict[str, str] = {}
    running: list[_Child] = []
    done = len(wanted) - len(todo)
    try:
        while todo or running:
            while todo and len(running) < options.jobs:
                running.append(_Child.start(blender, options, todo.pop(0)))
            time.sleep(_PAUSE)
            for child in [each for each in running if each.has_ended(60 * options.minutes)]:
                running.remove(child)
                facts, reason = child.result()
                done += 1
                if facts is None:
                    failed[child.wanted.path.name] = reason
                    collection.fail(child.wanted, reason)
                else:
                    facts["family"] = options.family or facts["family"]
                    collection.add(child.wanted, {**facts, "license": options.licence, "author": options.author})
                report(done / len(wanted), f"{child.wanted.path.name} ({done} of {len(wanted)})")
    finally:
        for child in running:
            child.kill()
    report(1.0, "finished")
    for name, reason in failed.items():
        print_message(f"'{name}' was not imported: {reason}")
    if len(failed) == len(wanted):
        raise InputError(f"None of the {len(wanted)} files could be imported; the reasons stand in '{options.out}'.")
    return f"'{options.out}' has {len(wanted) - len(failed)} of {len(wanted)} models" + (
        f"; {len(failed)} could not be imported and are listed in its catalog.json." if failed else "."
    )


def _import_here(options: argparse.Namespace) -> None:
    """What each Blender does: one file, its arrays and facts, or the reason why not, into the folder `into`."""
    require_bpy()
    from ..scene.rigged_assets import import_rigged

    (path,), (name, result) = options.files, (options.name, options.into / "result.json")
    try:
        asset = import_rigged(path)
        facts = write_asset(options.out, name, asset.arrays)
    except GSkinError as error:
        write_json(result, {"reason": str(error)})
        return
    write_json(result, {"facts": {**facts, "armature": asset.armature, "notes": asset.notes}})


@dataclass
class _Child:
    """A Blender that imports one file."""

    wanted: Wanted
    process: subprocess.Popen[bytes]
    folder: Path
    out: Path
    begun: float
    slow: bool = False

    @classmethod
    def start(cls, blender: list[str], options: argparse.Namespace, wanted: Wanted) -> _Child:
        folder = Path(tempfile.mkdtemp(prefix="gskin_import_"))
        own = ["train-guidance", "import", str(wanted.path.resolve()), "--out", str(options.out.resolve())]
        own += ["--licence", "-", "--into", str(folder), "--name", wanted.name, "--progress", "none"]
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen(
                [*blender, *own],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        return cls(wanted, process, folder, options.out, time.monotonic())

    def has_ended(self, most: float) -> bool:
        """Whether it is through; after `most` seconds it is ended."""
        if self.process.poll() is None and time.monotonic() - self.begun > most:
            self.slow = True
            self.process.kill()
            self.process.wait()
        return self.process.poll() is not None

    def result(self) -> tuple[dict[str, Any] | None, str]:
        """The asset's facts, or None and the reason."""
        try:
            said = json.loads((self.folder / "result.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            said = {"reason": self._last_words()}
        shutil.rmtree(self.folder, ignore_errors=True)
        if "facts" in said and npz_path(self.out, self.wanted.name).is_file():
            return said["facts"], ""
        return None, str(said.get("reason", "its arrays are gone"))

    def kill(self) -> None:
        """End it now."""
        self.process.kill()
        self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _last_words(self) -> str:
        if self.slow:
            return "it took longer than --minutes allows; give it more, or simplify the model"
        log = (self.folder / "log").read_text(encoding="utf-8", errors="replace")
        lines = [line.strip() for line in log.splitlines() if line.strip()]
        last = f" ({lines[-1][:200]})" if lines else ""
        return f"Blender ended with code {self.process.returncode}{last}; open it in Blender and save it again"


def _blender(given: Path | None) -> list[str]:
    """The command that runs this program in a Blender of its own, with scripts of files off."""
    headless = ["-b", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1"]
    headless += ["--python", str(PROGRAM), "--"]
    if given is not None:
        found = shutil.which(str(given))
        if found is None:
            raise InputError(f"'{given}' is no program that can be started; give the path of Blender.")
        return [found, *headless]
    inside: Any = sys.modules.get("bpy")
    if inside is not None and inside.app.binary_path:
        return [inside.app.binary_path, *headless]
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable, str(PROGRAM)]
    found = shutil.which("blender")
    if found is None:
        raise InputError(
            "Rigged models are read by Blender, and there is none here; name it with --blender PATH, or pip install "
            "'gskin_addon[blender]'."
        )
    return [found, *headless]
