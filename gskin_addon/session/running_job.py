# SPDX-License-Identifier: GPL-3.0-or-later
"""The job that runs, and the outcome of the last one. Blender has one of each, so this is global."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import bpy
from bpy.app.handlers import persistent

from . import live_pictures

if TYPE_CHECKING:
    from ..core.job.progress import ProgressEvent


class Job(Protocol):
    """What runs beside Blender, as panel and status bar see it."""

    title: str
    progress: ProgressEvent
    cancelling: bool

    @property
    def seconds_left(self) -> float | None: ...

    @property
    def pictures(self) -> Path | None:
        """Folder of the pictures that show how far it is, if it makes any."""

    def cancel(self) -> None: ...


@dataclass
class State:
    """The job that runs, if one does, and the last one's outcome in a sentence."""

    job: Job | None = None
    outcome: str = ""
    failed: bool = False
    details: str = ""
    shown: str = ""


state = State()


def begin(job: Job) -> None:
    """`job` runs from now on."""
    state.job, state.outcome, state.failed, state.details = job, "", False, ""


def end(outcome: str, *, failed: bool = False, details: str = "") -> None:
    """No job runs any more; `details` may be a traceback of the worker."""
    state.job, state.outcome, state.failed, state.details = None, outcome, failed, details
    live_pictures.forget()


def stop() -> None:
    """Stop a running job because the add-on goes."""
    if state.job is not None:
        state.job.cancel()
    end("")


@persistent
def forget_outcome(*_: object) -> None:
    """Another file was loaded: what the last job said is about objects of the old one."""
    if state.job is None:
        end("")


CLASSES = ()
HANDLERS = ((bpy.app.handlers.load_post, forget_outcome),)


def unregister() -> None:
    stop()
