# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender with gskin registered and a worker that only pretends, for tests of what surrounds a job."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import pytest
import worker_jobs as jobs

import gskin_addon
from gskin_addon.core.worker.client import WorkerClient
from gskin_addon.session import preferences, running_job, skin_job

CHAIN = (("lower", (0, 0, 0), (0, 0, 1)), ("upper", (0, 0, 1), (0, 0, 2)))


@contextmanager
def session(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[bpy.types.Scene]:
    """An empty scene; jobs are made in `folder`/jobs and done by fake_worker.py."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    preferences._found.clear()
    home = folder / "jobs"
    home.mkdir()
    monkeypatch.setattr(skin_job, "jobs_folder", lambda: home)
    monkeypatch.setattr(skin_job, "WorkerClient", functools.partial(WorkerClient, program=jobs.FAKE))
    gskin_addon.register()
    try:
        yield bpy.context.scene
    finally:
        running_job.stop()
        gskin_addon.unregister()


def add_armature(bones: Sequence[tuple] = CHAIN, name: str = "Rig") -> bpy.types.Object:
    """An armature with a chain of bones (name, head, tail)."""
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    parent = None
    for bone_name, head, tail in bones:
        bone = armature.data.edit_bones.new(bone_name)
        bone.head, bone.tail, bone.parent = head, tail, parent
        parent = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature
