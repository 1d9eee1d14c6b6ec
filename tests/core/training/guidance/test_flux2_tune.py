# SPDX-License-Identifier: GPL-3.0-or-later
"""Training a LoRA of FLUX.2 [klein], on a tiny pipeline of the real classes with random weights."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
pytest.importorskip("diffusers")
pytest.importorskip("peft")

import torch
from safetensors.torch import load_file
from tiny_flux import save_tiny_flux

from gskin_addon import cli
from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.files import read_arrays
from gskin_addon.core.guidance.flux2 import LORA, Flux2Painter
from gskin_addon.core.guidance.options import Flux2Options
from gskin_addon.core.pipeline import run as job
from gskin_addon.core.pipeline import steps
from gskin_addon.core.skinning import presets
from gskin_addon.core.training.guidance import flux2_tune
from gskin_addon.core.training.guidance.flux2_options import Flux2TuneOptions
from gskin_addon.core.training.guidance.flux2_tune import flow_loss, trained_parameters, tune
from gskin_addon.core.training.guidance.pairs import PairDataset
from gskin_addon.core.training.guidance.validate import validate
from tests.helpers.limb import make_limb
from tests.helpers.tiny_training import write_pairs


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return write_pairs(tmp_path_factory.mktemp("pairs") / "pairs", poses=1, views=1)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return save_tiny_flux(tmp_path_factory.mktemp("flux") / "klein")


def silent(_done, _message):
    return None


def silent_job(*_):
    return None


def fixed_loss(painter, pair):
    """The loss at six times that do not change."""
    with torch.no_grad():
        return np.mean([float(flow_loss(painter, pair, torch.Generator().manual_seed(seed))) for seed in range(6)])


def test_a_pair_is_learned_and_the_guidance_takes_the_lora(pairs, model, tmp_path):
    out, said = tmp_path / "tuned", []
    settings = {
        "model": str(model),
        "rank": 8,
        "batch": 1,
        "updates": 30,
        "checkpointing": False,
        "learning_rate": 2e-2,
        "weight_decay": 0.0,
        "steps": 2,
    }
    sentence = tune(pairs, out, settings, lambda done, message: said.append((done, message)))
    assert [done for done, _ in said] == sorted(done for done, _ in said)
    facts = json.loads((out / "fine_tuned.json").read_text())
    assert (facts["updates"], facts["pairs"], len(facts["losses"])) == (30, 1, 30)
    before, after = facts["validation"]["before"], facts["validation"]["after"]
    assert f"PSNR {before['psnr']:.4g} -> {after['psnr']:.4g}" in sentence

    pair = PairDataset(pairs)[0]
    plain = Flux2Painter(model, Flux2Options(model=str(model), device="cpu", steps=2))
    tuned = Flux2Painter(model, Flux2Options(model=str(model), device="cpu", steps=2, lora=str(out)))
    assert fixed_loss(tuned, pair) < 0.8 * fixed_loss(plain, pair)
    again = validate(tuned, PairDataset(pairs, "validation"), 64, 0, lambda done: None)
    assert again["raw_psnr"] == pytest.approx(after["raw_psnr"], abs=0.01)
    assert after["raw_psnr"] != before["raw_psnr"]
    layers = {key.split(".lora_")[0] for key in load_file(out / LORA)}
    assert "transformer.transformer_blocks.0.attn.add_k_proj" in layers
    assert "transformer.single_transformer_blocks.0.attn.to_qkv_mlp_proj" in layers
    assert len(layers) == 10

    # Whoever asks for what is there is told so, without a model being loaded.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flux2_tune, "Flux2Painter", None)
        assert tune(pairs, out, settings, silent) == sentence
    with pytest.raises(InputError, match=r"other settings \(rank was 8, is 4\)"):
        tune(pairs, out, {**settings, "rank": 4}, silent)
    # A LoRA is a start for another training, and not a new one beside it.
    more = {**settings, "lora": str(out), "updates": 1, "learning_rate": 0.0, "validation": 0}
    tune(pairs, tmp_path / "more", more, silent)
    for key, value in load_file(tmp_path / "more" / LORA).items():
        torch.testing.assert_close(value, load_file(out / LORA)[key], rtol=0, atol=0)


def test_what_the_command_trains_is_what_a_job_takes(pairs, model, tmp_path, monkeypatch, capsys):
    out = tmp_path / "tuned"
    words = ["train-guidance", "tune", str(pairs), "--model", "flux2", "--out", str(out), "--progress", "none"]
    values = {"model": str(model), "rank": 4, "batch": 1, "updates": 3, "learning_rate": 0.05, "steps": 2}
    for name, value in values.items():
        words += ["--option", f"{name}={value}"]
    assert cli.main(words) == 0, capsys.readouterr().err
    assert (out / LORA).is_file()
    monkeypatch.setitem(presets.PRESETS, "draft", presets.Preset("for tests", 1, ((64, 4),), 2, held_out=0))
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 64)
    limb = make_limb(300)
    options = {"model": str(model), "lora": str(out), "device": "cpu", "steps": 1}
    settings = {"preset": "draft", "guidance": "flux2", "options": options}
    outcome = job.run(limb.cloud, limb.skeleton, settings, silent_job, tmp_path)
    assert outcome.report["guidance_images"] == 4
    np.testing.assert_allclose(outcome.weights.sum(1), 1, atol=1e-5)


def test_a_stopped_training_ends_as_one_that_was_not(pairs, model, tmp_path):
    settings = {
        "model": str(model), "rank": 2, "batch": 1, "updates": 4, "save_minutes": 0.0, "validation": 0,
        "checkpointing": False,
    }  # fmt: skip
    tune(pairs, tmp_path / "whole", {**settings, "checkpointing": True}, silent)

    def stop(_done, message):
        if message.startswith("Update 3 "):
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        tune(pairs, tmp_path / "stopped", settings, stop)
    assert not (tmp_path / "stopped/fine_tuned.json").exists()
    went_on = []
    tune(pairs, tmp_path / "stopped", settings, lambda done, message: went_on.append(message))
    assert [message.split(",")[0] for message in went_on if message.startswith("Update")] == [
        "Update 3 of 4",
        "Update 4 of 4",
    ]
    whole, stopped = (load_file(tmp_path / name / LORA) for name in ("whole", "stopped"))
    for key, value in whole.items():
        torch.testing.assert_close(stopped[key], value, rtol=1e-4, atol=1e-6)


def test_the_loss_is_that_of_what_the_pipeline_asks_the_transformer(pairs, model):
    """The tokens, positions and prompt of the training are those of a call of the pipeline."""
    painter = Flux2Painter(model, Flux2Options(model=str(model), device="cpu", steps=1))
    pair, asked = PairDataset(pairs)[0], []
    handle = painter.pipeline.transformer.register_forward_pre_hook(
        lambda module, args, how: asked.append(how), with_kwargs=True
    )
    validate(painter, PairDataset(pairs, "validation"), 1, 0, lambda done: None)
    flow_loss(painter, pair, torch.Generator().manual_seed(0))
    handle.remove()
    sampled, trained = asked
    count = (pair.mask.shape[0] // painter.token) ** 2
    for name in ("encoder_hidden_states", "txt_ids", "img_ids"):
        torch.testing.assert_close(trained[name], sampled[name], rtol=0, atol=0)
    torch.testing.assert_close(trained["hidden_states"][:, count:], sampled["hidden_states"][:, count:])
    assert float(sampled["timestep"][0]) == pytest.approx(1.0)
    assert 0 < float(trained["timestep"][0]) < 1


def test_only_the_lora_is_trained_and_begins_without_effect(pairs, model):
    painter = Flux2Painter(model, Flux2Options(model=str(model), device="cpu"))
    pair = PairDataset(pairs)[0]
    before = fixed_loss(painter, pair)
    parameters = trained_parameters(painter, Flux2TuneOptions(rank=3))
    assert fixed_loss(painter, pair) == pytest.approx(before, rel=1e-6)
    learns = {name for name, value in painter.pipeline.transformer.named_parameters() if value.requires_grad}
    assert learns == set(parameters)
    assert all(".lora_" in name for name in learns)


def test_pairs_without_skeletons_and_wrong_settings(pairs, model, tmp_path, capsys):
    for values, words in (
        ({"dtype": "float16"}, "choose one of auto, float32, bfloat16"),
        ({"rank": 0}, "rank of 'flux2' is 0"),
        ({"ema": 0.5}, "no option 'ema'"),
        ({"lora": str(tmp_path)}, "does not exist"),
    ):
        with pytest.raises(InputError, match=words):
            tune(pairs, tmp_path / "out", {"model": str(model), **values}, silent)
    arguments = ["train-guidance", "tune", str(pairs), "--out", str(tmp_path / "out"), "--model", "flux2"]
    assert cli.main([*arguments, "--progress", "none"]) == 2
    assert "No FLUX.2 [klein] model is named" in capsys.readouterr().err
    old = shutil.copytree(pairs, tmp_path / "old")  # as an older gskin made them
    arrays = read_arrays(old / "shards/limb.npz")
    np.savez(old / "shards/limb.npz", **{name: a for name, a in arrays.items() if not name.startswith("bone")})
    new, read = PairDataset(pairs)[0], PairDataset(old)[0]
    assert read.bones is None
    assert new.bones.rest.shape == new.bones.posed.shape == (len(new.bones.bone), 2, 3)
    np.testing.assert_array_equal(read.posed, new.posed)
    with pytest.raises(InputError, match="hold no skeletons"):
        tune(old, tmp_path / "out", {"model": str(model)}, silent)
    np.savez(old / "shards/limb.npz", **{**arrays, "bone_0": arrays["bone_0"][1:]})
    with pytest.raises(InputError, match=r"limb\.npz' is damaged"):
        PairDataset(old)[0]
    assert not (tmp_path / "out").exists()
