# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import json

import numpy as np
import pytest
from rigged_assets import write_tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.training.catalogue import list_assets
from gskin_addon.core.training.collection import Collection, npz_path, rig_family, wanted_files, write_asset

SUFFIXES = (".glb", ".fbx")


def put(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def names(files):
    return [file.name for file in files]


def test_files_of_folders_get_names_of_their_own_and_keep_them(tmp_path):
    put(tmp_path / "a/My Fox.glb", "one")
    put(tmp_path / "b/c/my fox.FBX", "two")
    put(tmp_path / "b/copy.glb", "one")
    put(tmp_path / "b/notes.txt", "no model")
    empty = Collection(tmp_path / "out")
    files = wanted_files([tmp_path / "a", tmp_path / "b"], SUFFIXES, empty)
    assert names(files) == ["My_Fox", f"my_fox_{files[1].digest[:6]}"]  # the copy is the same file
    for file in files:
        empty.add(file, {"family": "f", "license": "CC0"})
    again = Collection(tmp_path / "out")
    assert names(wanted_files([tmp_path / "b"], SUFFIXES, again)) == [files[1].name, "My_Fox"]
    put(tmp_path / "a/My Fox.glb", "changed")
    (changed,) = wanted_files([tmp_path / "a"], SUFFIXES, again)
    assert changed.name == f"My_Fox_{changed.digest[:6]}"


def test_what_is_there_is_known_and_failures_are_listed_until_they_work(tmp_path):
    out = tmp_path / "out"
    (file,) = wanted_files([put(tmp_path / "fox.glb", "one")], SUFFIXES, Collection(out))
    collection = Collection(out)
    collection.fail(file, "it is broken")
    assert json.loads((out / "catalog.json").read_text())["failed"] == [
        {"name": "fox", "file": "fox.glb", "reason": "it is broken"}
    ]
    arrays = dict(np.load(write_tube(tmp_path / "tube.npz")))
    facts = write_asset(out, file.name, arrays)
    collection.add(file, {**facts, "license": "CC0", "author": "A. Tester"})
    again = Collection(out)
    assert again.table["failed"] == []
    assert again.has(file)
    (asset,) = list_assets(out)
    assert (asset.name, asset.license, asset.author, asset.family) == ("fox", "CC0", "A. Tester", facts["family"])
    npz_path(out, "fox").unlink()
    assert not again.has(file)


def test_arrays_that_training_could_not_use_are_refused_and_not_left_behind(tmp_path):
    arrays = dict(np.load(write_tube(tmp_path / "tube.npz")))
    with pytest.raises(InputError, match="damaged"):
        write_asset(tmp_path, "fox", {**arrays, "w_row": arrays["w_row"] + 10**6})
    with pytest.raises(InputError, match="'fox' has no bone that carries weights"):
        write_asset(tmp_path, "fox", {**arrays, "bone_used": np.zeros_like(arrays["bone_used"])})
    assert not npz_path(tmp_path, "fox").exists()


def test_assets_of_one_skeleton_are_a_family():
    bones, parents = np.array(["hip", "knee", "foot"]), np.array([-1, 0, 1])
    family = rig_family(bones, parents)
    assert rig_family(bones[[0, 2, 1]], np.array([-1, 2, 0])) == family
    assert rig_family(bones, np.array([-1, 0, 0])) != family
    assert rig_family(np.array(["hip", "knee", "toe"]), parents) != family


def test_what_cannot_be_read_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere' does not exist"):
        wanted_files([tmp_path / "nowhere"], SUFFIXES, Collection(tmp_path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no rigged models; give \.glb, \.fbx"):
        wanted_files([tmp_path / "empty"], SUFFIXES, Collection(tmp_path))
    for text in ("{", "[]", '{"assets": 3}'):
        put(tmp_path / "bad/catalog.json", text)
        with pytest.raises(InputError, match=r"bad/catalog.json'.*choose another --out"):
            Collection(tmp_path / "bad")


def test_a_gltf_is_its_buffers_and_pictures_too(tmp_path):
    """Two of one skeleton whose files differ in nothing but a texture are two models."""
    table = json.dumps({"buffers": [{"uri": "model.bin"}], "images": [{"uri": "a%20skin.png"}, {"uri": "data:,x"}, {}]})
    for folder, skin in (("red", "r"), ("blue", "b"), ("copy", "r")):
        for name, text in (("model.gltf", table), ("model.bin", "bones"), ("a skin.png", skin)):
            put(tmp_path / folder / name, text)
    put(tmp_path / "lost/model.gltf", table)  # no buffer: its failure is listed, not taken for a copy
    for number, broken in enumerate(("{", "[]", '{"buffers": 3, "images": [4]}')):
        put(tmp_path / f"broken/{number}.gltf", broken)
    files = wanted_files([tmp_path], (".gltf",), Collection(tmp_path / "out"))
    assert [file.path.parent.name for file in files] == ["blue", *["broken"] * 3, "copy", "lost"]
    put(tmp_path / "blue/model.bin", "others")
    (changed,) = wanted_files([tmp_path / "blue"], (".gltf",), Collection(tmp_path / "out"))
    assert changed.digest != files[0].digest
