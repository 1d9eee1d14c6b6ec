# SPDX-License-Identifier: GPL-3.0-or-later
"""The reader of safetensors files against the package's writer, and against files that lie."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from gskin_addon.core.skinning.learned.safetensors import read_safetensors


def test_what_the_package_writes_is_read(tmp_path):
    rng = np.random.default_rng(0)
    tensors = {
        "a": rng.normal(size=(3, 4)).astype(np.float16), "b": rng.normal(size=5).astype(np.float32),
        "c": rng.normal(size=(2, 1, 3)), "d": np.arange(4), "e": np.array(2.5, np.float32), "f": np.zeros((0, 3)),
    }  # fmt: skip
    save_file(tensors, tmp_path / "x", {"who": "me", "what": "{}"})
    metadata, found = read_safetensors(tmp_path / "x")
    assert metadata == {"who": "me", "what": "{}"}
    assert set(found) == set(tensors)
    for name, value in tensors.items():
        assert found[name].dtype == value.dtype
        np.testing.assert_array_equal(found[name], value)
    assert read_safetensors(tmp_path / "x", tensors=False) == (metadata, {})
    save_file({"a": np.zeros(2)}, tmp_path / "y")
    assert read_safetensors(tmp_path / "y")[0] == {}


def entry(dtype="F32", shape=(2,), offsets=(0, 8)):
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


@pytest.mark.parametrize(
    "header",
    [
        [], 3, {"a": []}, {"a": {}}, {"a": entry("Q7")}, {"a": entry(dtype=["F32"])}, {"a": entry(offsets=(0, 16))},
        {"a": entry(offsets=(8, 0))}, {"a": entry(offsets=(-8, 0))}, {"a": entry(offsets=(0, 4, 8))},
        {"a": entry(offsets=(0.0, 8.0))}, {"a": entry(shape=(3,))}, {"a": entry(shape=(-1, -2))},
        {"a": entry(shape=None)}, {"a": entry(shape=(True, 2))}, {"a": entry(shape=(2**40, 2**40))},
        {"__metadata__": 3}, {"__metadata__": {"a": 1}},
    ],
)  # fmt: skip
def test_headers_that_lie_are_refused(tmp_path, header):
    text = json.dumps(header).encode()
    path = tmp_path / "x"
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(8))
    with pytest.raises(ValueError, match=r"header|metadata|'a'|unpack"):
        read_safetensors(path)


@pytest.mark.parametrize("data", [b"", b"1234", bytes(8), b"\xff" * 16, (9).to_bytes(8, "little") + b"{\xff\xff"])
def test_files_that_are_cut_off_are_refused(tmp_path, data):
    (tmp_path / "x").write_bytes(data)
    with pytest.raises(ValueError):  # noqa: PT011  (json's own and ours)
        read_safetensors(tmp_path / "x")
