# SPDX-License-Identifier: GPL-3.0-or-later
"""Model files: they come back as they were, say what they left out, and wrong ones are refused by name."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from gskin_addon.core.errors import InputError
from gskin_addon.core.skinning.learned.model_file import (
    SHIPPED,
    ModelCard,
    load_model,
    models_without,
    read_card,
)
from gskin_addon.core.skinning.learned.network import Shape
from gskin_addon.core.training.prior.torch_network import PriorNetwork
from gskin_addon.core.training.prior.write_model import save_model

CARD = ModelCard(("Foxes", "Fish"), ("Cows",), {"steps": 3})


def test_a_model_comes_back(tmp_path):
    torch.manual_seed(0)
    networks = [PriorNetwork(Shape(width=32, heads=2)) for _ in range(2)]
    save_model(networks, tmp_path / "a.safetensors", CARD)
    again = load_model(tmp_path / "a.safetensors")
    assert len(again) == 2
    assert read_card(tmp_path / "a.safetensors") == CARD
    for network, same in zip(networks, again, strict=True):
        assert same.shape == network.shape
        for name, value in network.state_dict().items():
            torch.testing.assert_close(torch.from_numpy(same.parameters[name].copy()), value, rtol=1e-3, atol=1e-4)
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def test_the_model_that_never_saw_a_family_is_found(tmp_path):
    save_model([PriorNetwork()], tmp_path / "a.safetensors", CARD)
    save_model([PriorNetwork()], tmp_path / "b.safetensors", ModelCard(("Fish", "Cows"), (), {}))
    assert models_without("Cows", tmp_path) == tmp_path / "b.safetensors"
    assert models_without("Fish", tmp_path) == tmp_path / "a.safetensors"
    assert models_without("Birds", tmp_path) is None


def test_wrong_files_are_refused_in_one_sentence(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_model(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(InputError, match="no safetensors file"):
        load_model(tmp_path / "text.safetensors")
    save_file({"x": torch.zeros(3)}, tmp_path / "foreign.safetensors")
    with pytest.raises(InputError, match="no prior of gskin"):
        load_model(tmp_path / "foreign.safetensors")


def test_files_that_do_not_hold_what_they_say_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    save_model([PriorNetwork(Shape(width=32, heads=2))], path, CARD)
    with safe_open(path, "pt") as file:
        (key, words), tensors = next(iter(file.metadata().items())), {n: file.get_tensor(n) for n in file.keys()}  # noqa: SIM118
    about = json.loads(words)
    short = {name: value for name, value in tensors.items() if name != "0.hear.weight"}
    for changed, kept in (
        ({"networks": 2}, tensors),
        ({"networks": 10**12}, tensors),
        ({"networks": "one"}, tensors),
        ({"shape": {**about["shape"], "width": 64}}, tensors),
        ({"shape": {**about["shape"], "before": 10**12}}, tensors),
        ({"shape": {**about["shape"], "heads": 0}}, tensors),
        ({"shape": {"depth": 3}}, tensors),
        ({}, short),
        ({}, {**tensors, "0.mean": torch.full_like(tensors["0.mean"], float("nan"))}),
        ({}, {**tensors, "0.mean": tensors["0.mean"].to(torch.int32)}),
    ):
        save_file(kept, path, {key: json.dumps({**about, **changed})})
        with pytest.raises(InputError, match="does not hold the weights that it says"):
            load_model(path)
    lists = [json.dumps({**about, name: value}) for name in ("features", "left_out", "roles") for value in (None, 3)]
    for broken in ("{", json.dumps(list(about)), *lists):
        save_file(tensors, path, {key: broken})
        with pytest.raises(InputError, match="broken metadata"):
            load_model(path)
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(InputError, match="no safetensors file"):
        load_model(path)


def test_the_shipped_model_is_small_and_says_what_it_left_out():
    assert SHIPPED.stat().st_size < 8e6
    card = read_card(SHIPPED)
    assert "OpenDungeons" in card.left_out
    assert "mtg_character" not in card.families
    assert "Quaternius animated animals" in card.families
    assert len(load_model(SHIPPED)) == 3
