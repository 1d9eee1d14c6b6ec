# SPDX-License-Identifier: GPL-3.0-or-later
"""The default job in a Python as Blender's own is: numpy and nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from needs import WORKER, missing

bpy = pytest.importorskip("bpy")

from gskin_addon.core.job.contract import write_job
from gskin_addon.core.rig.kinematics import pose_transforms
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.poses import random_axes, random_poses
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.splats.ply import write_ply
from tests.helpers.limb import make_limb

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module", autouse=True)
def _numpy_only():
    """Skips where a library could help unseen."""
    if len(missing(*WORKER).split(",")) < len(WORKER):
        pytest.skip("this Python has more than numpy: `make test-versions`")


def test_learned_weights_of_a_limb():
    from gskin_addon.core.skinning.learned.predict import learned_weights

    limb = make_limb(3000)
    weights, confidence = learned_weights(limb.cloud, limb.skeleton)
    assert confidence.shape == (3000,)
    assert_moves_as_the_truth(weights, limb)


def test_the_worker_does_a_default_job(tmp_path):
    """The worker's own program, with the settings that a person meets who changes nothing."""
    limb = make_limb(3000)
    job = write_job(tmp_path / "job", limb.cloud, limb.skeleton, {})
    program = ROOT / "gskin_addon" / "core" / "worker" / "process.py"
    done = subprocess.run(
        [sys.executable, str(program), str(job)], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    assert_moves_as_the_truth(read_weights_file(job / "weights.npz").weights, limb)


def test_rig_and_pose_from_the_command_line(tmp_path, monkeypatch):
    """All that a person without torch does: rig, turn a bone, export."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    limb = make_limb(3000)
    rig = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    parent = None
    for name, head, tail in zip(limb.skeleton.names, limb.skeleton.heads, limb.skeleton.tails, strict=True):
        bone = rig.data.edit_bones.new(name)
        bone.head, bone.tail, bone.parent = head, tail, parent
        parent = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"), copy=True)
    write_ply(tmp_path / "limb.ply", limb.cloud)
    monkeypatch.delenv("GSKIN_PYTHON", raising=False)
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    gskin(tmp_path, "rig", "limb.ply", "--armature", "rig.blend", "--out", "out.blend", "--weights", "w.npz")
    gskin(tmp_path, "pose", "out.blend", "--out", "posed.glb", "--rotate", "bone1", "40", "0", "0")
    assert (tmp_path / "posed.glb").read_bytes().startswith(b"glTF")
    assert_moves_as_the_truth(read_weights_file(tmp_path / "w.npz").weights, limb)


def gskin(folder: Path, *arguments: str) -> None:
    """The command line in a Python of its own, which must also end: bpy 4.5 as a module likes to wait for ever."""
    command = [sys.executable, "-m", "gskin_addon.cli", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr


def assert_moves_as_the_truth(weights: np.ndarray, limb) -> None:
    """In random poses the splats lie nearer to where the true weights put them than with each on its own bone."""
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-4)
    rng = np.random.default_rng(5)
    poses = pose_transforms(limb.skeleton, random_poses(limb.skeleton, random_axes(8, rng), 8, rng))
    points = limb.cloud.means.astype(float)
    rigid = np.eye(limb.skeleton.count)[limb.weights.argmax(axis=1)]
    true, moved, apart = (skin_points(points, each, poses) for each in (limb.weights, weights, rigid))
    error, bar = (np.linalg.norm(each - true, axis=-1).mean() for each in (moved, apart))
    assert error < 0.8 * bar
