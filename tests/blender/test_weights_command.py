# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin weights` on saved rigged splats."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

from gskin_addon import cli
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import read_weights, write_weights

NAMES = ("spine", "arm.L", "arm.R")


@pytest.fixture(scope="module")
def rigged(tmp_path_factory):
    """A symmetric body of 600 splats with an arm on each side; the right arm has no weights. Path and weights."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rng = np.random.default_rng(2)
    cloud = clouds.random_cloud(600, 0)
    means = rng.random((300, 3)) * [1, 0.3, 2]
    cloud.means[:] = np.concatenate([means, means * [-1, 1, 1]])
    data = bpy.data.armatures.new("Rig")
    armature = bpy.data.objects.new("Rig", data)
    bpy.context.scene.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for name, head, tail in zip(
        NAMES, [(0, 0, 0), (0.2, 0, 1), (-0.2, 0, 1)], [(0, 0, 2), (1, 0, 1), (-1, 0, 1)], strict=True
    ):
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = head, tail
    bpy.ops.object.mode_set(mode="OBJECT")
    obj = create_splat_object(cloud, "Body")
    weights = np.zeros((600, 3), np.float32)
    weights[:300, 1] = np.clip(cloud.means[:300, 0] * 2 - 0.4, 0, 1)
    weights[:, 0] = 1 - weights[:, 1]
    write_weights(obj, armature, weights, NAMES)
    path = tmp_path_factory.mktemp("rigged") / "body.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path, weights


def run(capsys, *words):
    code = cli.main(["weights", *map(str, words)])
    return code, capsys.readouterr().err


def test_changes_come_in_the_order_given(rigged, tmp_path, capsys):
    path, before = rigged
    out = tmp_path / "out.blend"
    code, said = run(capsys, path, "--mirror", "left", "--sharpen", "1", "--out", out, "--weights", tmp_path / "w.npz")
    assert code == 0
    assert said.index("--mirror") < said.index("--sharpen")
    after = read_weights_file(tmp_path / "w.npz").weights
    sure = np.abs(before[:300, 1] - 0.5) > 0.1
    assert np.array_equal(after[:300][sure].argmax(axis=1), before[:300][sure].argmax(axis=1))
    assert np.array_equal(after[300:][sure].argmax(axis=1), np.where(before[:300, 1] > 0.5, 2, 0)[sure])
    np.testing.assert_allclose(after.max(axis=1), 1)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    obj = bpy.data.objects["Body"]
    np.testing.assert_allclose(read_weights(obj, NAMES)[0], after, atol=1e-6)
    rigs.random_pose(bpy.data.objects["Rig"], np.random.default_rng(0), 0.5)
    rigs.assert_same_pose(obj, bpy.data.objects["Rig"])


def test_selection_and_locks(rigged, tmp_path, capsys):
    path, before = rigged
    chosen = tmp_path / "chosen.txt"
    chosen.write_text("301, 302\n303")
    code, said = run(capsys, path, "--to-bone", "arm.R", "--select", chosen, "--weights", tmp_path / "w.npz")
    assert (code, "of 3 splats changed" in said) == (0, True)
    after = read_weights_file(tmp_path / "w.npz").weights
    assert (after[301:304] == [0, 0, 1]).all()
    rest = np.setdiff1d(np.arange(600), [301, 302, 303])
    np.testing.assert_allclose(after[rest], before[rest], atol=1e-6)
    code, said = run(
        capsys, path, "--smooth", 4, "--lock", "arm.L", "--select-bone", "spine", "--weights", tmp_path / "v.npz"
    )
    assert code == 0
    np.testing.assert_allclose(read_weights_file(tmp_path / "v.npz").weights[:, 1], before[:, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "Say where to"),
        (("--out", "x.glb"), "Nothing to do"),
        (("--out", "x.txt", "--smooth", "2"), ".blend or .glb"),
        (("--out", "x.glb", "--to-bone", "arm.R"), "--select"),
        (("--out", "x.glb", "--lock", "tail", "--smooth", "2"), "no such deform bone"),
        (("--out", "x.glb", "--select", "none.txt", "--smooth", "2"), "does not exist"),
        (("--out", "x.glb", "--flood", "arm.R", "2"), "0..1"),
        (("--out", "x.glb", "--mirror", "up"), "invalid choice"),
    ],
)
def test_bad_words_are_one_sentence(rigged, tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    code, heard = run(capsys, rigged[0], *words)
    assert code == 2
    assert said in heard
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "1, x", "700", "-1"])
def test_bad_selections(rigged, tmp_path, capsys, text):
    (tmp_path / "chosen.txt").write_text(text)
    words = ("--smooth", "2", "--select", tmp_path / "chosen.txt", "--weights", tmp_path / "w.npz")
    code, heard = run(capsys, rigged[0], *words)
    assert (code, "chosen.txt" in heard) == (2, True)


@pytest.mark.parametrize("kind", ["bools", "numbers", "text", "short", "short numbers"])
def test_masks_are_no_splat_numbers(rigged, tmp_path, capsys, kind):
    """Zeros and ones for splat after splat, as many programs write masks, would else name splats 0 and 1."""
    path, _ = rigged
    mask = np.zeros(599 if "short" in kind else 600, bool)
    mask[[301, 302, 303]] = True
    chosen = tmp_path / ("chosen.txt" if kind == "text" else "chosen.npz")
    if kind == "text":
        np.savetxt(chosen, mask, fmt="%d")
    else:
        np.savez(chosen, selected=mask.astype(np.uint8) if "numbers" in kind else mask)
    code, said = run(capsys, path, "--to-bone", "arm.R", "--select", chosen, "--weights", tmp_path / "w.npz")
    if "short" in kind:
        assert (code, "a mask of 599 splats, and there are 600" in said) == (2, True)
    else:
        assert (code, "of 3 splats changed" in said) == (0, True)


def test_splats_without_weights_follow_no_bone_most(rigged, tmp_path, capsys):
    path, _ = rigged
    bpy.ops.wm.open_mainfile(filepath=str(path))
    obj = bpy.data.objects["Body"]
    for group in obj.vertex_groups:
        group.remove([0, 1, 2])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "bare.blend"))
    with_spine = int((read_weights(obj, NAMES)[0].argmax(axis=1) == 0).sum()) - 3
    out = tmp_path / "out.blend"
    words = ("--select-bone", "spine", "--to-bone", "arm.R", "--limit", "2", "--normalise", "--out", out)
    code, said = run(capsys, tmp_path / "bare.blend", *words)
    assert (code, f"of {with_spine} splats changed" in said) == (0, True)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert (read_weights(bpy.data.objects["Body"], NAMES)[0][:3] == 0).all()


def test_normalise_is_for_all_and_other_changes_for_what_they_change(rigged, tmp_path, capsys):
    """Blender's own tools leave sums other than 1."""
    path, _ = rigged
    bpy.ops.wm.open_mainfile(filepath=str(path))
    obj = bpy.data.objects["Body"]
    obj.vertex_groups["arm.L"].add([0, 1, 2], 0.7, "REPLACE")
    painted = read_weights(obj, NAMES)[0]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "painted.blend"))
    sums = []
    for word in (("--mirror", "left"), ("--normalise",)):
        out = tmp_path / "out.blend"
        assert run(capsys, tmp_path / "painted.blend", *word, "--out", out)[0] == 0
        bpy.ops.wm.open_mainfile(filepath=str(out))
        after = read_weights(bpy.data.objects["Body"], NAMES)[0]
        sums.append(after[:3].sum(axis=1))
        if "left" in word:
            assert np.array_equal(after[:300], painted[:300])
    assert (sums[0] > 1.1).any()
    np.testing.assert_allclose(sums[1], 1, atol=1e-6)


def test_mirror_in_the_window(rigged):
    import gskin_addon

    path, before = rigged
    gskin_addon.register()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path))
        obj = bpy.data.objects["Body"]
        obj.select_set(True)
        bpy.context.view_layer.objects.active = obj
        assert bpy.ops.gskin.mirror_weights(source="left") == {"FINISHED"}
        after = read_weights(obj, NAMES)[0]
        assert len(read_cloud(obj).means) == 600
        assert np.abs(after[300:, 2] - before[:300, 1]).max() < 0.15
        assert np.abs(after[300:, 2] - before[:300, 1]).mean() < 0.02
    finally:
        gskin_addon.unregister()
