# SPDX-License-Identifier: GPL-3.0-or-later
"""The learning runtime as this Blender knows it: how it is, the installation that runs, the outcome of the last one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import bpy

from ..core.errors import GSkinError, InputError
from ..core.worker import runtime_folder as folders
from ..core.worker.runtime_choice import Choice, Source, find_backend, parse_source
from ..core.worker.runtime_client import RuntimeClient
from ..core.worker.runtime_folder import RuntimeStatus
from . import running_job
from .guidance_settings import online
from .preferences import addon_preferences, forget_found, runtime_folder

INSTALL, REPAIR = "gskin.install_runtime", "gskin.repair_runtime"
OFFLINE = (
    "Online access is off: turn on Preferences > System > Network > Allow Online Access, "
    "or choose a wheel folder in GSkin's preferences"
)

_REMEMBER = 2.0
_TICK = 0.2


@dataclass
class State:
    """The installation or removal that runs, if one does, and the last one's outcome in a sentence."""

    client: RuntimeClient | None = None
    removal: threading.Thread | None = None
    outcome: str = ""
    failed: bool = False
    log: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Remedy:
    """What is in the way, in a sentence, and the click that mends it: an operator's id and the button's text."""

    sentence: str
    operator: str
    label: str


state = State()
_seen: dict[Path, tuple[float, RuntimeStatus]] = {}


def status(context: bpy.types.Context) -> RuntimeStatus:
    """How the runtime is. Looks at a few files, and seldom: panels ask on every redraw."""
    folder = runtime_folder(context)
    now = time.monotonic()
    known = _seen.get(folder)
    if known is None or now - known[0] > _REMEMBER:
        known = _seen[folder] = (now, folders.look(folder))
    return known[1]


def remedy(context: bpy.types.Context) -> Remedy | None:
    """Why guidance cannot compute yet and which click mends it; None where the runtime will do or is on its way."""
    if state.client is not None or state.removal is not None:
        return None
    now = status(context)
    if now.state == "missing":
        return Remedy("Guidance needs the learning runtime (torch)", INSTALL, "Install the Learning Runtime...")
    if now.state == "broken":
        complete = now.manifest.get("state") == "ready"
        return Remedy(now.problem, REPAIR if complete else INSTALL, "Repair" if complete else "Go On Installing...")
    if now.state == "outdated":
        return Remedy(now.problem, INSTALL, "Update the Learning Runtime...")
    return None


def chosen_source(context: bpy.types.Context) -> Source:
    """Where packages come from by the preferences. Raises InputError, as `parse_source`."""
    preferences = addon_preferences(context)
    if preferences is None or preferences.runtime_source == "pytorch":
        return parse_source()
    kind = preferences.runtime_source
    place = {"mirror": preferences.runtime_index, "wheels": bpy.path.abspath(preferences.runtime_wheels)}
    return parse_source(kind, place.get(kind, ""))


def check_online(source: Source) -> None:
    """Raise InputError where packages would have to be fetched and Blender may not."""
    if source.needs_network and not online():
        raise InputError(OFFLINE)


def start(context: bpy.types.Context, action: Literal["install", "repair"], backend: str, diffusion: bool) -> None:
    """Start an installation in a process of its own.

    Raises:
        InputError: one runs already, a job runs, Blender is offline, or a choice will not do.
    """
    check_idle()
    source = chosen_source(context)
    check_online(source)
    folder = runtime_folder(context)
    client = RuntimeClient(action, folder, Choice(find_backend(backend), diffusion, source))
    client.start()
    state.client, state.outcome, state.failed, state.log = client, "", False, []
    forget()


def check_idle() -> None:
    """Raise InputError while an installation, a removal or a job is under way."""
    if state.client is not None:
        raise InputError("The learning runtime is being installed: wait for it or cancel it")
    if state.removal is not None:
        raise InputError("The learning runtime is being removed: wait for it")
    if running_job.state.job is not None:
        raise InputError("Auto-Skin is running: wait for it or cancel it")


def step() -> bool:
    """Take in what the installation said, or whether the removal is done; True while one runs. Never waits."""
    if state.removal is not None:
        if state.removal.is_alive():
            return True
        state.removal = None
        forget()
    client = state.client
    if client is None:
        return False
    client.poll()
    if client.state == "running":
        return True
    state.client, state.log = None, list(client.log)
    state.outcome, state.failed = client.sentence, client.state == "failed"
    forget()
    return False


def wait(print_progress: Callable[..., None]) -> str:
    """Wait for the installation, for scripts; returns its sentence. Raises GSkinError as it ended."""
    client = state.client
    if client is None:
        raise GSkinError("No installation runs.")
    try:
        return client.wait(print_progress)
    finally:
        step()


def follow() -> None:
    """Look at the installation from a timer until it ends; panels and preferences show it."""
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=_TICK, persistent=True)


def cancel() -> None:
    """Ask the installation to stop. Never waits."""
    if state.client is not None:
        state.client.cancel()


def remove(context: bpy.types.Context) -> None:
    """Start deleting the runtime, in a thread: there are tens of thousands of files.

    Raises:
        InputError: there is none of ours, or it is busy. GSkinError: the folder cannot be written.
    """
    check_idle()
    folder = runtime_folder(context)
    folders.give_up(folder)
    state.outcome, state.failed = "", False
    # Ends with Blender: what is left then is removed by the next click.
    state.removal = threading.Thread(target=_remove, args=(folder,), name="gskin-remove", daemon=True)
    state.removal.start()
    forget()


def wait_for_removal() -> str:
    """Wait until the files are gone, for scripts; returns its sentence. Raises GSkinError where some stay."""
    if state.removal is not None:
        state.removal.join()
    step()
    if state.failed:
        raise GSkinError(state.outcome)
    return state.outcome


def _remove(folder: Path) -> None:
    try:
        folders.remove(folder)
        state.outcome, state.failed = f"The learning runtime in '{folder}' was removed.", False
    except GSkinError as error:
        state.outcome, state.failed = str(error), True


def forget() -> None:
    """Look at the folder anew at the next question."""
    _seen.clear()
    forget_found()


def stop() -> None:
    """Stop an installation because the add-on goes."""
    cancel()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    state.client, state.removal, state.outcome, state.failed, state.log = None, None, "", False, []
    forget()


def _tick() -> float | None:
    running = step()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"PREFERENCES", "VIEW_3D"}:
                for region in area.regions:
                    if area.type == "PREFERENCES" or region.type == "UI":
                        region.tag_redraw()
    return _TICK if running else None
