# SPDX-License-Identifier: GPL-3.0-or-later
"""Where models come from, and that nothing comes from the network without consent."""

from __future__ import annotations

import pickle
from pathlib import Path

import huggingface_hub
import pytest
import torch
from safetensors.torch import save_file

from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.guidance.model_files import ModelFiles, find_model, is_hub_id, load_tensors, stamp

FILES = ModelFiles(
    "toy model", ("config.json", ("net/weights.safetensors", "net/*.index.json")), "MIT", "owner/toy"
)


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "toy"
    (folder / "net").mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    (folder / "net" / "weights.safetensors").write_bytes(b"x")
    return folder


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """An empty hub cache, and a record of what is asked of the hub."""
    asked = []
    real = huggingface_hub.snapshot_download

    def ask(repository, **how):
        asked.append((repository, how))
        if not how["local_files_only"]:
            raise OSError("no network in tests\nsecond line")
        return real(repository, cache_dir=tmp_path / "cache", **how)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", ask)
    return asked


def cached(tmp_path, files=("config.json", "net/weights.safetensors")):
    """A snapshot as the hub's own client leaves it."""
    folder = tmp_path / "cache" / "models--owner--toy"
    snapshot = folder / "snapshots" / ("0" * 40)
    for name in files:
        (snapshot / name).parent.mkdir(parents=True, exist_ok=True)
        (snapshot / name).write_text("{}")
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text("0" * 40)
    return snapshot


def test_a_folder_with_all_files_is_taken(model):
    assert find_model(str(model), FILES) == model


@pytest.mark.parametrize("lost", ["config.json", "net/weights.safetensors"])
def test_a_missing_file_is_named_with_its_place_and_licence(model, lost):
    (model / lost).unlink()
    with pytest.raises(InputError) as caught:
        find_model(str(model), FILES)
    text = str(caught.value)
    assert lost in text
    assert str(model) in text
    assert "licence: MIT" in text
    assert "owner/toy" in text


@pytest.mark.parametrize(("name", "words"), [("", "No toy model is named"), ("/not/there", "does not exist")])
def test_nothing_there(name, words):
    with pytest.raises(InputError, match=words):
        find_model(name, FILES)


def test_without_consent_only_the_cache_is_asked(hub, tmp_path):
    with pytest.raises(InputError, match=r"not on this machine; allow the download .*licence .*MIT"):
        find_model("owner/toy", FILES)
    snapshot = cached(tmp_path)
    assert find_model("owner/toy", FILES) == snapshot
    assert all(how["local_files_only"] for _, how in hub)


def test_an_incomplete_cache_names_the_file(hub, tmp_path):
    cached(tmp_path, ["config.json"])
    with pytest.raises(InputError, match=r"lacks 'net/weights.safetensors or .*allow the download"):
        find_model("owner/toy", FILES)


def test_with_consent_only_what_is_needed_is_fetched(hub):
    told = []
    with pytest.raises(GSkinError, match=r"could not be fetched \(no network in tests\)"):
        find_model("owner/toy@v2", FILES, allow_download=True, tell=told.append)
    (name, how), = hub
    assert (name, how["revision"]) == ("owner/toy", "v2")
    assert how["allow_patterns"] == ["config.json", "net/weights.safetensors", "net/*.index.json"]
    assert told == ["Fetching owner/toy@v2 (licence: MIT)"]


def test_names_that_are_hub_ids(tmp_path, monkeypatch):
    assert is_hub_id("owner/toy")
    assert is_hub_id("owner/toy@refs/pr/1")
    for name in ("/abs/path", "toy", "./owner/toy", "../owner/toy", "a/b/c", "C:\\models\\toy"):
        assert not is_hub_id(name)
    monkeypatch.chdir(tmp_path)
    Path("owner/toy").mkdir(parents=True)
    assert not is_hub_id("owner/toy")


def test_weights_of_both_kinds(tmp_path):
    tensors = {"a": torch.arange(3.0)}
    save_file(tensors, tmp_path / "a.safetensors")
    torch.save(tensors, tmp_path / "a.bin")
    for name in ("a.safetensors", "a.bin"):
        torch.testing.assert_close(load_tensors(tmp_path / name, "toy weights"), tensors)


class Bomb:
    def __reduce__(self):
        return Path.touch, (Path("went-off"),)


def test_code_in_a_pickle_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bomb.pt").write_bytes(pickle.dumps({"a": Bomb()}))
    with pytest.raises(InputError, match=r"bomb\.pt' cannot be read as plain weights"):
        load_tensors(Path("bomb.pt"), "toy weights")
    torch.save({"a": Bomb()}, "bomb2.pt")
    with pytest.raises(InputError, match=r"bomb2\.pt' cannot be read as plain weights"):
        load_tensors(Path("bomb2.pt"), "toy weights")
    assert not Path("went-off").exists()


@pytest.mark.parametrize("content", [b"", b"not weights at all"])
@pytest.mark.parametrize("name", ["a.safetensors", "a.pt"])
def test_damaged_weights_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        load_tensors(tmp_path / name, "toy weights")
    torch.save([1.0], tmp_path / "list.pt")
    with pytest.raises(InputError, match="named tensors"):
        load_tensors(tmp_path / "list.pt", "toy weights")
    with pytest.raises(InputError, match="does not exist"):
        load_tensors(tmp_path / "none.pt", "toy weights")


def test_the_stamp_tells_an_exchanged_file(model):
    before = stamp(model)
    assert before == stamp(model)
    (model / "net" / "weights.safetensors").write_bytes(b"xy")
    assert stamp(model) != before
