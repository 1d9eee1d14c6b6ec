# SPDX-License-Identifier: GPL-3.0-or-later
"""Checkpoints come back as they were, and are refused when they are something else."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from gskin_addon.core.checkpoint import FORMAT, load_checkpoint, save_checkpoint
from gskin_addon.core.errors import InputError

KEYS = st.one_of(st.text(max_size=5), st.integers(), st.booleans(), st.tuples(st.integers(), st.text(max_size=2)))
PLAIN = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**130), 2**130), st.floats(allow_nan=False), st.text(max_size=8)
)
VALUES = st.recursive(
    PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.dictionaries(KEYS, inner, max_size=4),
    ),
    max_leaves=12,
)


def kinds(value):
    """The kinds of everything in it: True equals 1, (1,) does not equal [1]."""
    if isinstance(value, dict):
        return [dict, [(kinds(key), kinds(item)) for key, item in value.items()]]
    if isinstance(value, list | tuple):
        return [type(value), [kinds(item) for item in value]]
    return type(value)


@given(state=st.dictionaries(KEYS, VALUES, max_size=4))
@settings(max_examples=60, deadline=None)
def test_plain_values_come_back_equal_and_of_their_kinds(tmp_path_factory, state):
    path = tmp_path_factory.mktemp("c") / "state"
    save_checkpoint(path, state)
    found = load_checkpoint(path)
    assert found == state
    assert kinds(found) == kinds(state)


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool]
)
def test_tensors_come_back_to_the_bit(tmp_path, dtype):
    base = torch.arange(12).reshape(3, 4).to(dtype)
    state = {"whole": base, "part": base[1:], "turned": base.T, "none": base[:0], "one": base[0, 1], "deep": [(base,)]}
    save_checkpoint(tmp_path / "state", state)
    found = load_checkpoint(tmp_path / "state")
    for name in ("whole", "part", "turned", "none", "one"):
        assert found[name].dtype == dtype
        assert torch.equal(found[name], state[name]), name
    assert torch.equal(found["deep"][0][0], base)
    found["whole"].zero_()
    assert torch.equal(found["part"], state["part"]), "they no longer share memory"


def test_what_was_read_does_not_hang_on_the_file(tmp_path):
    path = tmp_path / "state"
    save_checkpoint(path, {"a": torch.arange(5000)})
    found = load_checkpoint(path)["a"]
    with open(path, "r+b") as file:
        file.write(bytes(path.stat().st_size))
    assert torch.equal(found, torch.arange(5000))


def test_what_an_optimiser_and_random_generators_keep(tmp_path):
    layer = torch.nn.Linear(3, 2)
    adam = torch.optim.AdamW(layer.parameters(), betas=(0.9, 0.98))
    layer(torch.ones(3)).sum().backward()
    adam.step()
    random = np.random.default_rng(3)
    state = {
        "adam": adam.state_dict(),
        "network": OrderedDict(layer.state_dict()),
        "numpy": random.bit_generator.state,
        "torch": torch.get_rng_state(),
        "best": float("inf"),
    }
    save_checkpoint(tmp_path / "state", state)
    found = load_checkpoint(tmp_path / "state")
    again = torch.optim.AdamW(layer.parameters())
    again.load_state_dict(found["adam"])
    assert str(again.state_dict()) == str(adam.state_dict())
    other = np.random.default_rng(0)
    other.bit_generator.state = found["numpy"]
    assert other.random() == random.random()
    torch.set_rng_state(found["torch"])
    assert found["best"] == float("inf")


@pytest.mark.parametrize("value", [np.float32(1), np.zeros(3), object(), {1, 2}, b"bytes", print])
def test_other_things_are_not_written(tmp_path, value):
    with pytest.raises(TypeError, match="cannot hold"):
        save_checkpoint(tmp_path / "state", {"a": [value]})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "about",
    [
        None,
        "[",
        "[1]",
        "3",
        '{"tensor": "7"}',
        '{"tensor": ["0"]}',
        '{"dict": [[1]]}',
        '{"dict": [[[1], 2]]}',
        '{"dict": 3}',
        '{"exec": []}',
        '{"dict": [], "tuple": []}',
        "{}",
        '{"tuple": [' * 60 + "]}" * 60,
        "[" * 100_000,
    ],
)
def test_made_up_files_are_refused(tmp_path, about):
    path = tmp_path / "state"
    save_file({"0": torch.zeros(2)}, path, {"other": "x"} if about is None else {FORMAT: about})
    with pytest.raises(InputError, match=r"state'.*delete it"):
        load_checkpoint(path)


def test_damaged_and_missing_files_are_refused(tmp_path):
    path = tmp_path / "state"
    save_checkpoint(path, {"a": torch.ones(100)})
    whole = path.read_bytes()
    for data in (b"", b"PK\x03\x04", whole[:50], whole[:-8]):
        path.write_bytes(data)
        with pytest.raises(InputError, match="state'"):
            load_checkpoint(path)
    path.unlink()
    with pytest.raises(InputError, match="state'"):
        load_checkpoint(path)
