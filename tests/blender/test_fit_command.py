# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin fit` and `gskin rig --fit`."""

from __future__ import annotations

import json
from itertools import pairwise

import capsule_person as persons
import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from gskin_addon import cli
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.splats.ply import write_ply


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("person") / "person.ply"
    write_ply(path, persons.person(3000))
    return path


def run(capsys, *words):
    code = cli.main([*map(str, words)])
    return code, capsys.readouterr().err


def test_bones_alone_as_json(file, tmp_path, capsys):
    out = tmp_path / "bones.json"
    code, said = run(capsys, "fit", file, "--up", "z", "--kind", "human", "--out", out)
    assert code == 0, said
    skeleton = Skeleton.from_json(out.read_text())
    knee = skeleton.heads[skeleton.names.index("shin.L")]
    assert np.linalg.norm(knee - persons.joints()["knee.L"]) < 0.12
    assert "heel.02.L" not in skeleton.names


def test_splats_and_rig_as_blend_and_bound_at_once(file, tmp_path, capsys):
    out = tmp_path / "rig.blend"
    code, said = run(capsys, "fit", file, "--up", "z", "--kind", "human", "--no-rigify", "--out", out)
    assert code == 0, said
    bpy.ops.wm.open_mainfile(filepath=str(out))
    kinds = {obj.type for obj in bpy.context.scene.objects}
    assert kinds == {"MESH", "ARMATURE"}
    rigged, weights = tmp_path / "rigged.blend", tmp_path / "w.npz"
    code, said = run(
        capsys, "rig", file, "--up", "z", "--fit", "human", "--no-rigify", "--out", rigged, "--weights", weights
    )
    assert code == 0, said
    found = read_weights_file(weights)
    bone = found.bones[found.weights[persons.person(3000).means[:, 2].argmax()].argmax()]
    assert bone == "spine.006"  # the crown follows the head


def test_joints_of_another_program(file, tmp_path, capsys):
    joints = persons.joints()
    lines = [f"joints {name} {100 * x} {100 * z} {-100 * y}" for name, (x, y, z) in joints.items()]
    lines += ["hier hips neck", "hier neck head"]
    for side in "LR":
        lines += [f"hier neck shoulder.{side}", f"hier hips thigh.{side}"]
        for limb in (("shoulder", "elbow", "wrist"), ("thigh", "knee", "ankle", "toe")):
            lines += [f"hier {a}.{side} {b}.{side}" for a, b in pairwise(limb)]
    rig, out = tmp_path / "rig.txt", tmp_path / "rig.json"
    rig.write_text("\n".join(lines))
    code, said = run(capsys, "fit", file, "--up", "z", "--skeleton", rig, "--out", out)
    assert code == 0, said
    assert "rig.txt': unit changed" in said
    data = json.loads(out.read_text())
    place = data["heads"][data["names"].index("knee.L")]
    assert np.linalg.norm(np.array(place) - joints["knee.L"]) < 0.02


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--out", "a.json"), "Say what to fit: --kind human, or --skeleton FILE"),
        (("--kind", "human", "--out", "a.glb"), "--out 'a.glb'"),
        (("--kind", "human", "--out", "a.json", "--landmark", "hand.L", "1", "2", "x"), "are not three numbers"),
        (("--skeleton", "a.fbx", "--out", "a.json"), "A '.fbx' needs Blender's importers"),
    ],
)
def test_mistakes_are_one_sentence(file, capsys, words, reason):
    code, said = run(capsys, "fit", file, *words)
    assert code == 2
    assert reason in said
