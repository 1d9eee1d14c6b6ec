# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin runtime`: install, look at, repair and remove the learning runtime."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Literal

from ..core.errors import InputError
from ..core.job.progress import ProgressEvent
from ..core.job.progress_text import ProgressPrinter
from ..core.worker import runtime_folder as folders
from ..core.worker.runtime_choice import MIRROR, PIP, WHEELS, Choice, Source, find_backend, parse_source
from ..core.worker.runtime_client import RuntimeClient
from .console import print_message


def run(options: argparse.Namespace) -> None:
    """Do `options.action`. Raises InputError, GSkinError, Cancelled."""
    folder = folders.runtime_folder(str(options.folder or ""))
    if options.action == "status":
        _status(folder)
    elif options.action == "remove":
        _remove(folder, options.yes)
    else:
        _install(folder, options)


def _status(folder: Path) -> None:
    status = folders.look(folder)
    print_message(f"{status.state.capitalize()}: {status.sentence.rstrip('.')} ('{folder}').")
    if not status.usable:
        raise InputError("There is no working learning runtime; `gskin runtime install` makes one.")


def _remove(folder: Path, agreed: bool) -> None:
    if not agreed:
        raise InputError(f"This deletes '{folder}'; say --yes to do it.")
    folders.remove(folder)
    print_message(f"The learning runtime in '{folder}' was removed.")


def _install(folder: Path, options: argparse.Namespace) -> None:
    action: Literal["install", "repair"] = options.action
    source = _source(options)
    made = folders.look(folder).choice
    if action == "repair" and folders.look(folder).state == "missing":
        raise InputError(f"There is no learning runtime in '{folder}'; `gskin runtime install` makes one.")
    if made is not None and action == "repair":
        choice = Choice(made.backend, made.diffusion, source)
    else:
        choice = Choice(find_backend(options.backend), options.diffusion, source)
    blender = sys.modules.get("bpy")
    if blender is not None and source.needs_network and not blender.app.online_access:
        raise InputError("Blender's online access is off; start it with --online-mode, or use --wheels FOLDER.")
    print_message(
        f"torch for {choice.backend.title}: about {choice.download / 1000:.1f} GB to fetch ({source.sentence}), "
        f"{choice.disk / 1000:.1f} GB on the disk in '{folder}'."
    )
    for line in choice.licences:
        print_message(f"  {line}")
    client = RuntimeClient(action, folder, choice, options.base or "")
    printer = ProgressPrinter(options.progress)
    client.start()
    try:
        sentence = client.wait(lambda event: printer(ProgressEvent(event.stage, event.fraction, message=event.message)))
    finally:
        printer.close()
        if options.verbose:
            print_message("\n".join(client.log))
    print_message(sentence)


def _source(options: argparse.Namespace) -> Source:
    if options.wheels is not None:
        return parse_source(WHEELS, str(options.wheels))
    if options.index:
        return parse_source(PIP) if options.index == PIP else parse_source(MIRROR, options.index)
    return parse_source()
