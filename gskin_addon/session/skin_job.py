# SPDX-License-Identifier: GPL-3.0-or-later
"""One run of Auto-Skin as the scene sees it: objects out to a job folder, weights back to the objects."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import GSkinError, InputError
from ..core.guidance import DEFAULT_GUIDANCE
from ..core.job.contract import LOCK, Result, prepare_job
from ..core.job.lock import job_lock
from ..core.job.mesh_files import mesh_file
from ..core.job.progress import ProgressEvent
from ..core.job.scope import Scope, scope_file
from ..core.job.settings import JobSettings
from ..core.skinning.edits.assign import normalise
from ..core.skinning.initial import PRESENT
from ..core.worker.client import WorkerClient
from ..core.worker.own_python import own_python
from ..scene import names
from ..scene.anchored import read_world_mesh
from ..scene.armature import read_skeleton
from ..scene.fabric import iter_fabric, lay_under
from ..scene.given_weights import iter_give_weights
from ..scene.object_ref import object_by_uid
from ..scene.proxy_object import iter_write_weights_through
from ..scene.seams import read_seams
from ..scene.single_user import said_of, sharers
from ..scene.splat_object import read_cloud, splat_count
from ..scene.steps import Steps, part_of, run_to_end
from ..scene.weights import read_weights

Array = NDArray[Any]

KEPT_JOBS = 3
"""Stopped jobs that are kept, so that the same click goes on where it was."""

_ROOT = __package__.rpartition(".")[0]


@dataclass
class SkinJob:
    """A worker busy for a splat object and an armature, known by session id because names may change."""

    title = "Auto-Skin"

    client: WorkerClient
    splats: tuple[int, str]
    armature: tuple[int, str]
    count: int
    max_influences: int
    proxy: tuple[int, str] | None = None
    anchored: bool = True
    kept: bool = False
    only: Array | None = None
    paintable: bool = False
    edges_only: bool = False
    started: float = field(default_factory=time.monotonic)
    progress: ProgressEvent = field(default_factory=lambda: ProgressEvent("start"))
    progress_at: float = field(default_factory=time.monotonic)
    cancelling: bool = False
    _result: Result | None = None

    @classmethod
    def start(
        cls,
        splats: bpy.types.Object,
        armature: bpy.types.Object,
        settings: dict[str, Any],
        python: Path,
        proxy: bpy.types.Object | None = None,
        *,
        anchored: bool = True,
        folder: Path | None = None,
        label: str = "",
        allow_download: bool = False,
        only: Array | None = None,
        paintable: bool = False,
    ) -> SkinJob:
        """Write the job of these objects at rest, in world space, and start a worker on it.

        With `proxy`, a mesh object, the weights are learned on its vertices and the splats are anchored to it, or
        (anchored=False) get weights of their own from it. folder: where the job is kept, also after its end; one of
        the user's own, for the time of the run, when left out. only (N,) bool: splats whose weights may change; a
        guidance then starts from the present ones. Not with a proxy. label: what messages call the splats.
        allow_download: the person agreed to fetch models that are missing; this run only, nothing keeps it. paintable:
        the splats get a fabric for Blender's weight tools.

        Raises:
            InputError: objects that cannot be skinned, an interpreter that cannot be started.
            GSkinError: the job folder cannot be written.
        """
        chosen = JobSettings.parse(settings)
        skeleton = read_skeleton(armature)
        cloud = read_cloud(splats)
        files = {}
        if proxy is not None:
            name, arrays = mesh_file(*read_world_mesh(proxy))
            settings, files = {**settings, "mesh": name}, {name: arrays}
        else:
            # A mesh knows which parts belong together; loose splats need the artist's seams.
            scope = Scope(walls=read_seams(splats))
            if only is not None and chosen.guidance != DEFAULT_GUIDANCE:
                present = normalise(read_weights(splats, skeleton.names)[0])
                scope = Scope(present, np.flatnonzero(only), scope.walls)
                scope = scope.checked(cloud.count, skeleton.count, f"'{splats.name}'")
                settings = {**settings, "init": PRESENT, "init_options": {}}
            if not scope.empty:
                name, arrays = scope_file(scope)
                settings, files = {**settings, "scope": name}, {name: arrays}
        job = prepare_job(
            cloud,
            skeleton,
            settings,
            files=files,
            splats=label or f"'{splats.name}'",
            armature=f"Armature '{armature.name}'",
            up=str(splats.data[names.MARK].get("up", "z")),
        )
        home = folder
        if home is None:
            forget_old_jobs(jobs_folder())
            home = jobs_folder() / job.fingerprint
        client = WorkerClient(
            python,
            job.write(home),
            isolated=python == own_python(),
            gentle=not bpy.app.background,
            allow_download=allow_download,
        )
        client.start()
        return cls(
            client,
            (splats.session_uid, splats.name),
            (armature.session_uid, armature.name),
            cloud.count,
            chosen.max_influences,
            None if proxy is None else (proxy.session_uid, proxy.name),
            anchored,
            folder is not None,
            only,
            paintable,
            chosen.edges_only,
        )

    def wait(self, show: Callable[[ProgressEvent], None]) -> None:
        """Wait for the worker and `show` its progress; for programs without a window.

        Raises:
            WorkerError: the job failed. Cancelled: it was cancelled.
        """
        self._result = self.client.wait(show)

    def step(self) -> bool:
        """Take in what the worker said; True while it runs. Never waits.

        Raises:
            InputError: an object was deleted meanwhile; the worker is then being stopped.
        """
        events = self.client.poll()
        if events:
            self.progress, self.progress_at = events[-1], time.monotonic()
        if not self.cancelling:
            self._objects()
        return self.client.state == "running"

    def cancel(self) -> None:
        """Ask the worker to stop. Never waits."""
        self.cancelling = True
        self.client.cancel()

    def apply(self) -> str:
        """Write the weights of the ended job to the objects; returns a sentence about them.

        A proxy mesh gets its weights too, and the splats follow it.

        Raises:
            GSkinError: the job did not end well, or the objects are not what they were; nothing is written.
        """
        return run_to_end(self.apply_steps())

    def apply_steps(self) -> Steps[str]:
        """`apply` in slices. Only the last one changes the scene; closing it before leaves all as it was."""
        splats, armature, *proxies = self._objects()
        result = self.client.result() if self._result is None else self._result
        if splat_count(splats) != self.count:
            raise InputError(
                f"'{splats.name}' had {self.count} splats when the job started, now {splat_count(splats)}; "
                "run Auto-Skin again."
            )
        name, words = armature.name, ""
        shared = said_of(splats, sharers(splats))
        options: dict[str, Any] = {"max_influences": self.max_influences, "confidence": result.confidence}
        fabric = None
        if self.paintable and not proxies:
            bone = result.weights.argmax(axis=1)
            fabric = yield from part_of(iter_fabric(splats, bone, armature), 0.0, 0.1)
        if proxies and self.anchored:
            if result.mesh_weights is None:
                raise GSkinError("The worker gave no weights for the mesh; run Auto-Skin again.")
            weights = result.weights, result.mesh_weights
            through = splats, proxies[0], armature, *weights, result.bones
            yield from iter_write_weights_through(*through, **options, edges_only=self.edges_only)
        else:
            start_name = str(result.report.get("start") or "initial weights")
            start = None if result.start is None else (start_name, result.start)
            words = yield from iter_give_weights(
                splats, armature, result.weights, result.bones, only=self.only, start=start, **options
            )
        if fabric is not None:
            lay_under(splats, fabric)
        if not self.kept:
            shutil.rmtree(self.client.folder, ignore_errors=True)
        seconds = time.monotonic() - self.started
        words = words or f"{self.count:,} splats follow {len(result.bones)} bones of '{name}' ({seconds:.0f} s)"
        words = f"{words}; {shared}" if shared else words
        summary = result.report.get("summary")
        return f"{words}; {summary}" if isinstance(summary, str) and summary else words

    @property
    def pictures(self) -> Path:
        """Folder of the guidance and weights that the worker shows."""
        return self.client.folder

    @property
    def seconds_left(self) -> float | None:
        """The worker's estimate, counted down since it was made."""
        left = self.progress.seconds_left
        return None if left is None else max(0.0, left - (time.monotonic() - self.progress_at))

    def _objects(self) -> list[bpy.types.Object]:
        """The splat object, the armature, and the proxy mesh where there is one."""
        found = []
        wanted = [(self.splats, "splat object"), (self.armature, "armature")]
        if self.proxy is not None:
            wanted.append((self.proxy, "mesh"))
        for (uid, name), what in wanted:
            obj = _object_by_uid(uid, name)
            if obj is None:
                self.cancel()
                raise InputError(
                    f"The {what} '{name}' was deleted while its weights were made; nothing was written."
                )
            found.append(obj)
        return found


def jobs_folder() -> Path:
    """Where this Blender keeps its jobs: the extension's folder, or the user's data where it is none."""
    try:
        folder = bpy.utils.extension_path_user(_ROOT, path="jobs", create=True)
    except ValueError:
        folder = bpy.utils.user_resource("DATAFILES", path="gskin/jobs", create=True)
    if not folder:
        raise GSkinError("Blender's folder for user data cannot be made; check that the disk is not full.")
    return Path(folder)


def forget_old_jobs(home: Path, keep: int = KEPT_JOBS) -> None:
    """Remove all but the `keep` latest jobs in `home` that no worker is busy with."""
    jobs = sorted((path for path in home.iterdir() if path.is_dir()), key=lambda path: path.stat().st_mtime)
    for folder in jobs[: max(0, len(jobs) - keep)]:
        with contextlib.suppress(GSkinError):
            with job_lock(folder / LOCK, patience=0.0):
                free = True
            if free:
                shutil.rmtree(folder, ignore_errors=True)


def _object_by_uid(uid: int, name: str) -> bpy.types.Object | None:
    """The object, whatever it is called now; None when it is gone or in no scene, as deleted ones are."""
    obj = object_by_uid(uid, name)
    return obj if obj is not None and obj.users_scene else None
