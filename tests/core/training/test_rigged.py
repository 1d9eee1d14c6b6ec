# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import json

import numpy as np
import pytest
from rigged_assets import write_collection, write_tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.training.catalogue import Asset, list_assets
from gskin_addon.core.training.guidance.split import TRAIN, VALIDATION, split_families
from gskin_addon.core.training.rigged import load_asset, read_rigged_mesh


def test_an_asset_becomes_splats_with_the_weights_of_the_surface(tmp_path):
    asset = load_asset(write_tube(tmp_path / "tube.npz"), 500)
    assert asset.cloud.count == 500
    assert asset.skeleton.names == ("bone0", "bone1", "bone2")  # the control bone carries nothing
    assert list(asset.skeleton.parents) == [-1, 0, 1]
    np.testing.assert_allclose(asset.weights.sum(1), 1, atol=1e-5)
    inside = np.clip(asset.cloud.means[:, 0], 0.01, 2.99)
    middle = np.abs(inside % 1 - 0.5) < 0.2
    np.testing.assert_array_equal(asset.weights[middle].argmax(1), inside[middle].astype(int))
    assert asset.clip is None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"w_val": None}, "lacks the array w_val"),
        ({"bone_used": np.zeros(4, bool)}, "no bone that carries weights"),
        ({"verts": np.zeros((250, 3))}, "no surface"),
    ],
)
def test_assets_that_cannot_be_used(tmp_path, changed, words):
    with pytest.raises(InputError, match=words):
        load_asset(write_tube(tmp_path / "tube.npz", **changed), 100)


def test_damaged_and_missing_assets(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK no zip")
    for name in ("a.npz", "b.npz"):
        with pytest.raises(InputError, match=f"{name}' cannot be read"):
            load_asset(tmp_path / name, 100)


def test_a_catalogue_gives_families_and_licences(tmp_path):
    write_collection(tmp_path / "set", {"fox": 2, "ogre": 1}, {"ogre": "CC-BY-SA-3.0"})
    assert [asset.name for asset in list_assets(tmp_path / "set")] == ["fox_0", "fox_1"]
    everything = list_assets(tmp_path / "set", any_licence=True)
    assert [(a.name, a.family, a.license) for a in everything][-1] == ("ogre_0", "ogre", "CC-BY-SA-3.0")
    catalog = tmp_path / "set" / "catalog.json"
    entries = json.loads(catalog.read_text())["assets"]
    entries[1]["near_duplicate_of"] = "fox_0"
    catalog.write_text(json.dumps({"assets": entries}))
    assert [asset.name for asset in list_assets(tmp_path / "set")] == ["fox_0"]
    assert [asset.name for asset in list_assets(tmp_path / "set", near_duplicates=True)] == ["fox_0", "fox_1"]
    catalog.write_text(json.dumps({"assets": [{**entry, "license": "CC-BY-SA-3.0"} for entry in entries]}))
    with pytest.raises(InputError, match="licence to learn from"):
        list_assets(tmp_path / "set")
    for key in ("family", "license"):
        catalog.write_text(json.dumps({"assets": [{k: v for k, v in entries[0].items() if k != key}]}))
        with pytest.raises(InputError, match=f"not a catalogue of assets .'{key}'"):
            list_assets(tmp_path / "set")
    catalog.write_text('{"assets": 3}')
    with pytest.raises(InputError, match="not a catalogue"):
        list_assets(tmp_path / "set")


def test_a_folder_without_catalogue_is_taken_as_it_is(tmp_path):
    write_tube(tmp_path / "b.npz")
    write_tube(tmp_path / "a.npz")
    assert [(a.name, a.family) for a in list_assets(tmp_path)] == [("a", "a"), ("b", "b")]
    with pytest.raises(InputError, match="does not exist"):
        list_assets(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no assets"):
        list_assets(tmp_path / "empty")


def assets(**families):
    return [Asset(f"{name}{k}", None, name) for name, count in families.items() for k in range(count)]


@pytest.mark.parametrize("seed", range(6))
def test_no_family_trains_and_validates(seed):
    everything = assets(big=30, a=3, b=2, c=4, d=1, e=5)
    chosen = split_families(everything, 0.15, seed)
    families = {split: {asset.family for asset in members} for split, members in chosen.items()}
    assert not families[TRAIN] & families[VALIDATION]
    assert len(chosen[TRAIN]) + len(chosen[VALIDATION]) == len(everything)
    assert 1 <= len(chosen[VALIDATION]) <= 0.15 * len(everything)
    assert chosen == split_families(everything[::-1], 0.15, seed)


def test_small_sets_balance_and_families_left_out():
    chosen = split_families(assets(a=5, b=7), 0.1, 0)
    assert {asset.family for asset in chosen[VALIDATION]} == {"a"}  # the smaller, though above the share
    assert not split_families(assets(a=5), 0.1, 0)[VALIDATION]
    assert not split_families(assets(a=5, b=7), 0.0, 0)[VALIDATION]
    few = split_families(assets(a=50, b=3, c=2), 0.3, 0, per_family=4, leave_out=["c"])
    names = [asset.name for members in few.values() for asset in members]
    assert sum(name.startswith("a") for name in names) == 4
    assert not any(name.startswith("c") for name in names)
    with pytest.raises(InputError, match="no family 'x'"):
        split_families(assets(a=5), 0.1, 0, leave_out=["x"])
    with pytest.raises(InputError, match="Every family is left out"):
        split_families(assets(a=5), 0.1, 0, leave_out=["a"])


def test_a_file_may_say_less_and_lists_bones_in_any_order(tmp_path):
    plain = read_rigged_mesh(write_tube(tmp_path / "plain.npz"))
    less = dict.fromkeys(("bone_names", "bone_rest", "bone_used"))
    told = read_rigged_mesh(write_tube(tmp_path / "less.npz", **less))
    assert told.skeleton.names == ("0", "1", "2", "3")
    np.testing.assert_array_equal(told.used, plain.used)
    np.testing.assert_array_equal(told.skeleton.rest[:, :3, 3], told.skeleton.heads)
    # The control bone last, in place of first.
    order = [1, 2, 3, 0]
    with np.load(tmp_path / "plain.npz") as file:
        moved = {name: file[name][order] for name in file.files if name.startswith("bone_")}
        moved |= {"bone_parent": np.array([3, 0, 1, -1]), "w_col": file["w_col"] - 1}
    mixed = read_rigged_mesh(write_tube(tmp_path / "mixed.npz", **moved))
    assert mixed.skeleton.names == plain.skeleton.names
    np.testing.assert_array_equal(mixed.weights, plain.weights)
    np.testing.assert_array_equal(mixed.skeleton.parents, plain.skeleton.parents)
    np.testing.assert_array_equal(mixed.used, plain.used)


@pytest.mark.parametrize("parents", [[-1, 2, 1, 2], [-1, 0, 9, 2]])
def test_a_rig_that_is_no_tree_is_damaged(tmp_path, parents):
    with pytest.raises(InputError, match=r"tube.npz' is damaged"):
        load_asset(write_tube(tmp_path / "tube.npz", bone_parent=np.array(parents)), 100)
