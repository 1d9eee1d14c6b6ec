# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole job: `ours:default`, `ours:<init>+<guidance>`, with `@<preset>` behind it for another preset, `oracle`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.guidance import GUIDANCE
from gskin_addon.core.job.mesh_files import write_mesh
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.skinning.initial import INITIAL_WEIGHTS
from gskin_addon.core.skinning.presets import PRESETS

from .base import Method, MethodInput, MethodResult, Unavailable
from .heat import weld
from .learned import unseen_model

LIMIT = 1800.0


def job_settings(name: str) -> dict[str, Any]:
    """Settings of job.json for a method's name.

    Raises:
        ValueError: a name of another form. Unavailable: an init, guidance or preset that this version lacks.
    """
    if name == "oracle":
        return {"guidance": "oracle", "init": "visibility"}
    what, _, preset = name.removeprefix("ours:").partition("@")
    settings: dict[str, Any] = {}
    if what != "default":
        init, plus, guidance = what.partition("+")
        if not plus:
            raise ValueError(f"'{name}' is not 'ours:default' or 'ours:<init>+<guidance>'.")
        settings = {"init": init, "guidance": guidance}
    if preset:
        settings["preset"] = preset
    for key, known in (("init", INITIAL_WEIGHTS), ("guidance", GUIDANCE), ("preset", PRESETS)):
        if key in settings and settings[key] not in known:
            raise Unavailable(f"this version has no {key} '{settings[key]}'")
    return settings


def create(name: str) -> Method:
    """The method; see the module."""
    return create_job(job_settings(name))


def create_job(settings: dict[str, Any], *, on_mesh: bool = False) -> Method:
    """The job with settings of job.json; on_mesh: learns on the asset's own mesh, the splats anchored to it."""
    learned = settings.get("init", JobSettings().init) == "learned"

    def make(subject: MethodInput) -> MethodResult:
        from gskin_addon.core.pipeline.run import run

        chosen, note = dict(settings), ""
        if learned:
            model = unseen_model(subject.asset.name)
            chosen["init_options"], note = {"model": str(model)}, f"model {model.stem}"
        with tempfile.TemporaryDirectory() as folder:
            if chosen.get("guidance") == "oracle":
                if subject.truth is None:
                    raise Unavailable("perfect guidance has no meaning on a disturbed skeleton")
                truth = Path(folder) / "truth.npz"
                np.savez(truth, weights=subject.truth)
                chosen["options"] = {"oracle_weights": str(truth)}
            checkpoint = Path(folder) / "checkpoint"
            checkpoint.mkdir()
            if on_mesh:
                verts, faces, _ = weld(subject.surface.verts, subject.surface.faces)
                chosen["mesh"] = write_mesh(Path(folder), verts, faces)
            outcome = run(subject.cloud, subject.skeleton, chosen, lambda *_: None, checkpoint)
        return MethodResult(outcome.weights, note, mesh_weights=outcome.mesh_weights)

    return Method(make, LIMIT)
