# SPDX-License-Identifier: GPL-3.0-or-later
"""The fine-tuning, on models of the published layout that are small enough to learn four pairs in seconds."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch

os.environ.setdefault("HF_HUB_OFFLINE", "1")
pytest.importorskip("diffusers")
pytest.importorskip("transformers")
pytest.importorskip("accelerate")

from safetensors.torch import load_file

from gskin_addon import cli
from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.lightning_drag import weights
from gskin_addon.core.guidance.lightning_drag.files import find_files
from gskin_addon.core.guidance.lightning_drag.pipeline import LightningDragPainter, Schedule
from gskin_addon.core.guidance.options import LightningDragOptions
from gskin_addon.core.training.guidance import finetune
from gskin_addon.core.training.guidance.drag_loss import DragLoss, trained_parameters
from gskin_addon.core.training.guidance.examples import Examples, batches, collate, pair_number
from gskin_addon.core.training.guidance.finetune import tune
from gskin_addon.core.training.guidance.pairs import PairDataset
from gskin_addon.core.training.guidance.tune_state import STATE, Average
from gskin_addon.core.training.guidance.validate import chosen_pairs, validate
from tests.helpers.tiny_training import write_pairs, write_tiny

ENCODER = "appearance_encoder/diffusion_pytorch_model.safetensors"
ATTENTION = "lightning-drag-sd15-attn.bin"
POINTS = "point_embedding/point_embedding.pt"
ALONE = {
    f"appearance.mid_block.attentions.0.transformer_blocks.0.attn1.to_{name}.weight" for name in ("q", "k")
}  # fmt: skip
"""At 64 pixels that block has one token, whose attention to itself is 1 whatever these are: they have no gradient, and
move by rounding alone, on some processors."""


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return write_pairs(tmp_path_factory.mktemp("pairs") / "pairs")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tiny") / "models")


@pytest.fixture(scope="module")
def model(models):
    return load(models)


def load(models, **roles):
    files = find_files(LightningDragOptions(models=str(models), scheduler="ddim", **roles))
    return weights.load(files, torch.float32)


def silent(_done, _message):
    return None


def read(folder):
    found = {f"appearance.{key}": value for key, value in load_file(folder / ENCODER).items()}
    for name in (ATTENTION, POINTS):
        found |= {f"{name}.{key}": value for key, value in torch.load(folder / name, weights_only=True).items()}
    return found


def test_four_pairs_are_learned_and_the_guidance_takes_the_result(pairs, models, tmp_path):
    lpips = tmp_path / "lpips.pt"
    torch.jit.trace(lambda a, b: (a - b).abs().mean(), (torch.rand(1, 3, 64, 64),) * 2).save(str(lpips))
    said = []
    settings = {
        "models": str(models),
        "steps": 4,
        "batch": 4,
        "learning_rate": 1e-2,
        "weight_decay": 0.0,
        "updates": 36,
        "ema": 0.9,
        "checkpointing": False,
        "lpips": str(lpips),
    }
    out = tmp_path / "tuned"
    sentence = tune(pairs, out, settings, lambda done, message: said.append((done, message)))
    facts = json.loads((out / "fine_tuned.json").read_text())
    before, after = facts["validation"]["before"], facts["validation"]["after"]
    losses = [entry["loss"] for entry in facts["losses"]]
    assert len(losses) == facts["updates"] == 36
    assert np.mean(losses[-6:]) < 0.6 * losses[0]
    assert after["pairs"] == before["pairs"] == 4
    assert after["psnr"] > before["psnr"] + 0.7
    assert after["ssim"] > before["ssim"]
    assert after["lpips"] < before["lpips"]
    assert f"PSNR {before['psnr']:.4g} -> {after['psnr']:.4g}" in sentence
    # Outside the mask a raw image may differ from the rest view; the composited one does not.
    assert after["raw_psnr"] < after["psnr"]
    assert after["raw_psnr"] > before["raw_psnr"]
    assert {"raw_ssim", "raw_lpips"} < set(after)
    assert f"(raw images: PSNR {before['raw_psnr']:.4g} -> {after['raw_psnr']:.4g}, SSIM" in sentence
    assert [done for done, _ in said] == sorted(done for done, _ in said)

    tuned, start = read(out), read(models / "lightning_drag")
    assert {key: value.shape for key, value in tuned.items()} == {key: value.shape for key, value in start.items()}
    adapter = torch.load(models / "ip_adapter/models/ip-adapter_sd15.bin", weights_only=True)["ip_adapter"]
    for key, value in tuned.items():
        if "_ip." in key:  # not trained: what the IP-Adapter put there
            torch.testing.assert_close(value, adapter[key.removeprefix(f"{ATTENTION}.")], rtol=0, atol=0)
        elif key not in ALONE:
            assert not torch.equal(value, start[key]), key

    options = LightningDragOptions(models=str(models), scheduler="ddim", lightning_drag=str(out))
    assert find_files(options).fine_tuned()["max_points"] == 0
    schedule = Schedule.of("ddim", 4)
    cpu = torch.device("cpu")
    painter = LightningDragPainter(
        load(models, lightning_drag=str(out)), schedule, device=cpu, dtype=torch.float32, batch=4
    )
    again = validate(painter, PairDataset(pairs, "validation"), 64, 0, lambda done: None)
    assert again["psnr"] == pytest.approx(after["psnr"], abs=0.01)

    # Whoever asks for what is there is told so, without a model being loaded.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finetune, "load", None)
        assert tune(pairs, out, settings, silent) == sentence


SHORT = {"steps": 1, "batch": 2, "accumulate": 2, "learning_rate": 1e-3, "updates": 3, "save_minutes": 0.0}


def test_a_killed_training_ends_as_one_that_was_not(pairs, models, tmp_path):
    settings = {**SHORT, "models": str(models), "validation": 1, "checkpointing": True}
    tune(pairs, tmp_path / "whole", settings, silent)

    def kill(_done, message):
        if message.startswith("Update 2 "):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(pairs, tmp_path / "killed", settings, kill)
    assert not (tmp_path / "killed/fine_tuned.json").exists()
    went_on = []
    # Activations computed twice are the same activations.
    tune(pairs, tmp_path / "killed", {**settings, "checkpointing": False}, lambda _, message: went_on.append(message))
    assert [message[:8] for message in went_on if message.startswith("Update")] == ["Update 2", "Update 3"]
    whole, killed = read(tmp_path / "whole"), read(tmp_path / "killed")
    for key, value in whole.items():
        torch.testing.assert_close(killed[key], value, rtol=0, atol=0, msg=key)
    facts = [json.loads((tmp_path / name / "fine_tuned.json").read_text()) for name in ("whole", "killed")]
    assert facts[0] == facts[1]

    with pytest.raises(InputError, match=r"other settings \(learning_rate was 0.001, is 0.1\); choose another --out"):
        tune(pairs, tmp_path / "whole", {**settings, "learning_rate": 0.1}, silent)
    (tmp_path / "killed/fine_tuned.json").unlink()
    (tmp_path / "killed" / STATE).write_bytes(b"half")
    with pytest.raises(InputError, match=r"checkpoint .* cannot be read"):
        tune(pairs, tmp_path / "killed", settings, silent)


def test_the_command(pairs, models, tmp_path, capsys):
    out = tmp_path / "tuned"
    command = ["train-guidance", "tune", str(pairs), "--out", str(out), "--progress", "none"]
    options = {"models": models, "updates": 1, "validation": 0, "batch": 1}
    given = [word for name, value in options.items() for word in ("--option", f"{name}={value}")]
    assert cli.main([*command, *given]) == 0
    assert "1 updates; there were no pairs to validate on" in capsys.readouterr().err
    assert cli.main([*command, "--option", "rate=1"]) == 2
    assert "no option 'rate'" in capsys.readouterr().err
    assert cli.main([*command[:2], str(tmp_path), *command[3:], *given]) == 2
    assert "no set of image pairs" in capsys.readouterr().err


def test_what_trains_is_what_lightning_drag_trains(model):
    names = trained_parameters(model)
    attentions = {name.rsplit(".", 2)[0] for name in names if name.startswith("attention.")}
    assert attentions == {f"attention.{number}" for number in range(0, len(model.processors), 2)}
    assert sum(name.startswith("points.") for name in names) == 13
    assert sum(name.startswith("appearance.") for name in names) == len(model.appearance.state_dict())
    assert sum(name.startswith("attention.") for name in names) == 3 * len(attentions)
    assert not any("_ip" in name for name in names)


@torch.no_grad()
def test_dropped_points_are_not_seen_and_a_batch_is_the_mean_of_its_examples(pairs, model):
    examples = Examples(PairDataset(pairs), 2, 28, 0)
    batch = collate([examples[0, 0], examples[0, 1]])
    other = replace(batch, maps=batch.maps.roll(9, dims=-1))

    def loss(drop, what):
        return DragLoss(model, drop, torch.device("cpu"), torch.float32)(what)

    assert torch.equal(loss(1.0, batch), loss(1.0, other))
    assert not torch.equal(loss(0.0, batch), loss(0.0, other))
    single = [loss(0.5, collate([examples[0, place]])) for place in (0, 1)]
    torch.testing.assert_close(loss(0.5, batch), torch.stack(single).mean(), rtol=1e-5, atol=1e-6)


def test_processes_share_an_update_and_an_epoch_sees_each_pair_once(pairs):
    assert sorted(pair_number(5, 3, position) for position in range(5)) == list(range(5))
    orders = [[pair_number(50, 3, 50 * epoch + k) for k in range(50)] for epoch in (0, 1)]
    assert orders[0] != orders[1]
    examples = Examples(PairDataset(pairs), 4, 28, 0)
    whole = list(batches(examples, range(2), 4, 1, process=0, processes=1, workers=0))
    halves = [list(batches(examples, range(2), 2, 1, process=p, processes=2, workers=0)) for p in (0, 1)]
    for update in (0, 1):
        parts = [half[update] for half in halves]
        assert [seed for part in parts for seed in part.seeds] == whole[update].seeds
        torch.testing.assert_close(torch.cat([part.posed for part in parts]), whole[update].posed)
    later = list(batches(examples, range(1, 2), 2, 2, process=0, processes=1, workers=0))
    assert [seed for part in later for seed in part.seeds] == whole[1].seeds


def test_the_average_starts_fast_and_is_put_in_place_for_a_while():
    value = torch.nn.Parameter(torch.zeros(1))
    average = Average({"a": value}, 0.9)
    slow = 0.0
    for update in range(1, 60):
        with torch.no_grad():
            value.fill_(float(update))
        average.update(update)
        decay = min(0.9, (1 + update) / (10 + update))
        slow = decay * slow + (1 - decay) * update
    assert average.values["a"].item() == pytest.approx(slow, rel=1e-5)
    with average.in_place():
        assert value.item() == pytest.approx(slow, rel=1e-5)
    assert value.item() == 59.0
    none = Average({"a": value}, 0.0)
    none.update(1)
    with none.in_place():
        assert value.item() == 59.0


def test_validation_takes_pairs_from_everywhere():
    assert chosen_pairs(100, 5) == [0, 25, 50, 74, 99]
    assert chosen_pairs(3, 64) == [0, 1, 2]


def test_what_cannot_be_used_is_named(pairs, models, tmp_path):
    with pytest.raises(InputError, match="No base inpainting model is named"):
        tune(pairs, tmp_path / "out", {}, silent)
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"no")
    with pytest.raises(InputError, match="does not hold LPIPS as TorchScript"):
        tune(pairs, tmp_path / "out", {**SHORT, "models": str(models), "lpips": str(broken)}, silent)
    assert not (tmp_path / "out/fine_tuned.json").exists()
