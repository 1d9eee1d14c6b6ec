# SPDX-License-Identifier: GPL-3.0-or-later
"""`gskin train-prior` from a folder of assets to a model that the job can use; stopping; wrong input."""

from __future__ import annotations

import numpy as np
import pytest
from rigged_assets import write_collection, write_tube

from gskin_addon import cli
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.skinning.learned.model_file import read_card
from gskin_addon.core.skinning.learned.predict import learned_weights
from gskin_addon.core.training.prior import sampling_plan
from gskin_addon.core.training.prior.examples import read_mesh_asset, without_unused_bones
from gskin_addon.core.training.prior.sampling_plan import CREATURES
from gskin_addon.core.training.prior.train import Trainer
from tests.helpers.limb import make_limb

LICENCES = {"Tubes": "CC0", "Pipes": "CC-BY-4.0", "Hoses": "CC-BY-SA-3.0"}


@pytest.fixture
def assets(tmp_path, monkeypatch):
    monkeypatch.setattr(sampling_plan, "PER_FAMILY", 1)
    folder = write_collection(tmp_path / "assets", dict.fromkeys(LICENCES, 1), LICENCES)
    # Three bones, and a control bone that comes before its parent; neither names nor used bones are told.
    odd = {"bone_parent": np.array([3, -1, 1, 2]), "bone_names": None, "bone_used": None, "bone_rest": None}
    write_tube(folder / "npz" / "Pipes_0.npz", 3, **odd)
    return folder


def train(assets, out, *more):
    fixed = ["--steps", "3", "--creatures", "1", "--networks", "2", "--threads", "1"]
    fixed += ["--cache", str(out.parent / "samples")]
    return cli.main(["train-prior", "--assets", str(assets), "--out", str(out), *fixed, *more])


def test_assets_become_a_model_that_jobs_can_use(assets, tmp_path):
    out = tmp_path / "mine.safetensors"
    assert train(assets, out, "--leave-out", "Tubes") == 0
    card = read_card(out)
    assert card.left_out == ("Tubes", "OpenDungeons")
    assert card.families == ("Pipes", CREATURES)
    limb = make_limb(500)
    weights, _ = learned_weights(limb.cloud, limb.skeleton, out)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    JobSettings.parse({"init": "learned", "init_options": {"model": str(out)}})


def test_a_stopped_training_goes_on_and_ends_the_same(assets, tmp_path, monkeypatch, capsys):
    whole, stopped = tmp_path / "whole.safetensors", tmp_path / "stopped.safetensors"
    assert train(assets, whole) == 0
    step = Trainer.step

    def interrupted(self):
        if self.schedule.seed == 1 and self.step_number == 2:  # in the second of the two networks
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(Trainer, "step", interrupted)
    assert train(assets, stopped) == 130
    assert "goes on from" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.glob("stopped*")) == ["stopped.0.checkpoint", "stopped.1.checkpoint"]
    monkeypatch.setattr(Trainer, "step", step)
    assert train(assets, stopped) == 0
    assert [path.name for path in tmp_path.glob("stopped*")] == ["stopped.safetensors"]
    assert stopped.read_bytes() == whole.read_bytes()


def test_control_bones_are_known_by_their_weights(assets):
    mesh = read_mesh_asset(assets / "npz" / "Pipes_0.npz")
    mesh.skeleton.validate()
    assert mesh.used.sum() == 3
    skeleton, weights = without_unused_bones(mesh.skeleton, mesh.weights, mesh.used)
    np.testing.assert_allclose(skeleton.heads[:, 0], [0, 1, 2])
    assert skeleton.parents.tolist() == [-1, 0, 1]
    np.testing.assert_allclose(weights.sum(axis=1), 1)


def test_wrong_input_is_one_sentence(assets, tmp_path, capsys):
    out = tmp_path / "m.safetensors"
    assert train(tmp_path / "nowhere", out) == 2
    said = capsys.readouterr().err
    assert "catalog.json" in said
    assert "nowhere' does not exist" in said
    assert train(assets, out, "--leave-out", "Cats") == 2
    assert "'Cats' is no family" in capsys.readouterr().err
    assert train(assets, out, "--fold", "seventh") == 2
    assert "people" in capsys.readouterr().err
    assert train(assets, tmp_path / "m.bin") == 2
    assert ".safetensors" in capsys.readouterr().err
    (assets / "npz" / "Tubes_0.npz").write_bytes(b"no")
    # Hoses are share-alike: known, though never learned from.
    assert train(assets, out, "--leave-out", "Pipes", "--leave-out", "Hoses") == 2
    assert "Tubes_0.npz" in capsys.readouterr().err
