# SPDX-License-Identifier: GPL-3.0-or-later
"""Model files: they come back as they were, say what they left out, and wrong ones are refused by name."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from gskin_addon.core.errors import InputError
from gskin_addon.core.skinning.learned.model_file import (
    SHIPPED,
    ModelCard,
    load_model,
    models_without,
    read_card,
    save_model,
)
from gskin_addon.core.skinning.learned.network import PriorNetwork, Shape

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
            torch.testing.assert_close(same.state_dict()[name], value, rtol=1e-3, atol=1e-4)
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


def test_the_shipped_model_is_small_and_says_what_it_left_out():
    assert SHIPPED.stat().st_size < 8e6
    card = read_card(SHIPPED)
    assert "OpenDungeons" in card.left_out
    assert "mtg_character" not in card.families
    assert "Quaternius animated animals" in card.families
    assert len(load_model(SHIPPED)) == 3
