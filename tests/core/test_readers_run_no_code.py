# SPDX-License-Identifier: GPL-3.0-or-later
"""No file that the package reads can run code: every reader gets pickles that would leave a mark."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import pickle
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import worker_jobs as jobs
from rigged_assets import write_tube

import gskin_addon
from gskin_addon.commands.selection import read_walls
from gskin_addon.core.checkpoint import load_checkpoint
from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance import oracle
from gskin_addon.core.guidance.lightning_drag.files import read_table
from gskin_addon.core.guidance.model_files import load_tensors
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.job import contract
from gskin_addon.core.job.contract import read_job, read_result
from gskin_addon.core.job.mesh_files import SUFFIXES, read_mesh
from gskin_addon.core.job.scope import Scope, read_scope, scope_file
from gskin_addon.core.job.skinned_files import SKINNED, read_skinned, read_surface, read_weights
from gskin_addon.core.pipeline import optimise_loop, steps
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.skinning import presets
from gskin_addon.core.skinning.learned.model_file import load_model, models_without, read_card
from gskin_addon.core.splats.formats import SUFFIXES as SPLATS
from gskin_addon.core.splats.formats import read_splats
from gskin_addon.core.splats.ply import read_ply
from gskin_addon.core.training.catalogue import list_assets
from gskin_addon.core.training.guidance.pairs import PairDataset, encode_image
from gskin_addon.core.training.guidance.tune_state import OLD_STATE, STATE, load_state
from gskin_addon.core.training.guidance.validate import load_lpips
from gskin_addon.core.training.prior.examples import read_mesh_asset
from gskin_addon.core.training.prior.samples import TrainingSample, asset_sample, sample_file
from gskin_addon.core.training.prior.sampling_plan import SamplingPlan
from gskin_addon.core.training.prior.train import Schedule, Trainer
from gskin_addon.core.training.rigged import load_asset
from tests.helpers.limb import make_limb

PACKAGE = Path(gskin_addon.__file__).parent


class Bomb:
    """Unpickled, it makes the folder `marker`."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.makedirs, (str(self.marker),)


def plain_pickle(bomb):
    return pickle.dumps({"weights": bomb})


def old_pickle(bomb):
    return pickle.dumps(bomb, protocol=0)


def torch_file(bomb):
    buffer = io.BytesIO()
    torch.save({"optimiser": {"iteration": bomb}, "weights": torch.zeros(2)}, buffer)
    return buffer.getvalue()


def old_torch_file(bomb):
    buffer = io.BytesIO()
    torch.save({"weights": bomb}, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()


def object_array(bomb):
    buffer = io.BytesIO()
    np.save(buffer, np.array([bomb], object))
    return buffer.getvalue()


NAMES = [
    *("weights", "bones", "heads", "tails", "parents", "confidence", "mesh_weights"),
    *("means", "quats", "scales", "opacities", "sh", "verts", "faces"),
    *("version", "names", "bone", "values", "view", "rest_0", "posed_0", "mask_0", "handles_0", "targets_0"),
    *("bone_parent", "bone_names", "bone_head", "bone_tail", "bone_rest", "bone_used"),
    *("present", "only", "walls", "corner_rgb", "w_row", "w_col", "w_val", "selected"),
]


def object_arrays(bomb):
    """Objects under each name that a reader may ask for; the keys make it an .npz for all of them."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in NAMES:
            archive.writestr(f"{name}.npy", object_array(bomb))
        archive.writestr("data.pkl", plain_pickle(bomb))
    return buffer.getvalue()


BOMBS = [plain_pickle, old_pickle, torch_file, old_torch_file, object_array, object_arrays]


@pytest.fixture(params=BOMBS, ids=lambda bomb: bomb.__name__)
def bomb(request, tmp_path):
    """Bytes that leave a mark when they are unpickled; after the test there must be none."""
    marker = tmp_path / "MARK"
    yield request.param(Bomb(marker))
    assert not marker.exists(), "the file ran code"


@pytest.fixture
def put(bomb, tmp_path):
    """Write the bomb to a file of a name."""

    def write(name):
        path = tmp_path / "files" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bomb)
        return path

    return write


@pytest.mark.parametrize("make", BOMBS)
def test_the_bombs_do_go_off(tmp_path, make):
    marker = tmp_path / "MARK"
    data = io.BytesIO(make(Bomb(marker)))
    if make in (torch_file, old_torch_file):
        torch.load(data, weights_only=False)
    elif make is object_array:
        np.load(data, allow_pickle=True)
    elif make is object_arrays:
        assert np.load(data, allow_pickle=True)["weights"].dtype == object
    else:
        pickle.load(data)
    assert marker.exists()


@pytest.mark.parametrize("name", ["job.json", "splats.npz", "skeleton.json"])
def test_a_job(put, tmp_path, name):
    folder = jobs.make_job(tmp_path / "job")
    shutil.copy(put(name), folder / name)
    with pytest.raises(InputError, match=name):
        read_job(folder)


def test_a_result(put, tmp_path):
    with pytest.raises(InputError, match=r"w\.npz"):
        read_weights_file(put("w.npz"))
    folder = jobs.make_job(tmp_path / "job")
    shutil.copy(put("weights.npz"), folder / "weights.npz")
    shutil.copy(put("report.json"), folder / "report.json")
    with pytest.raises(InputError, match=r"weights\.npz"):
        read_result(folder)


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".pkl", ".npy", ".pickle", ".dae", ".3mf", ".zip", ".json", ".xyz", ""])
def test_a_mesh(put, suffix):
    if suffix not in (".npz", ".pkl", ".npy", ".pickle"):
        pytest.importorskip("trimesh")
    with pytest.raises(InputError, match="mesh"):
        read_mesh(put(f"mesh{suffix}"))


@pytest.mark.parametrize("suffix", [*SKINNED, ".obj"])
def test_meshes_with_weights(put, suffix):
    path = put(f"mesh{suffix}")
    for read in (read_skinned, read_surface, lambda path: read_weights(path, ["bone"])):
        with pytest.raises(InputError):
            read(path)


@pytest.mark.parametrize("suffix", [".npz", ".txt"])
def test_marked_splats(put, suffix):
    with pytest.raises(InputError):
        read_walls([put(f"marked{suffix}")], 5)


def test_a_scope(put, tmp_path):
    with pytest.raises(InputError, match=r"scope\.npz"):
        read_scope(put("scope.npz"), 3, 1)
    scope = Scope(present=np.ones((3, 1), np.float32), walls=np.arange(3))
    name, arrays = scope_file(scope)
    contract.prepare_job(*jobs.rod(), {"scope": name}, files={name: arrays}).write(tmp_path / "job")
    np.testing.assert_array_equal(read_scope(tmp_path / "job" / name, 3, 1).walls, np.arange(3))


def test_splats(put):
    with pytest.raises(InputError, match=r"a\.ply"):
        read_ply(put("a.ply"))
    with contextlib.suppress(InputError):  # by chance a whole number of splats
        read_splats(put("b.splat"), drop_invalid=True)
    for suffix in (*sorted({*SPLATS} - {".splat"}), ".zip", ".pkl", ""):
        with pytest.raises(InputError, match=rf"b{suffix}"):
            read_splats(put(f"b{suffix}"), drop_invalid=True)
    with pytest.raises(InputError, match=r"meta\.json"):
        read_splats(put("folder/meta.json"))


def test_weights_of_the_oracle(put):
    limb = make_limb(20)
    nothing = np.zeros((20, limb.skeleton.count), np.float32)
    for name in ("w.npz", "w.npy", "w.pkl"):
        context = GuidanceContext(
            limb.cloud, limb.skeleton, nothing, nothing, options={"oracle_weights": str(put(name))}
        )
        with pytest.raises(InputError, match=name):
            oracle.create(context)


@pytest.mark.parametrize("suffix", [".safetensors", ".bin", ".pt"])
def test_weights_of_a_model(put, suffix):
    with pytest.raises(InputError, match=r"cannot be read as plain weights"):
        load_tensors(put(f"model{suffix}"), "model")


def test_a_pickle_is_not_given_to_an_old_torch(tmp_path, monkeypatch):
    torch.save({"a": torch.ones(2)}, tmp_path / "model.bin")
    assert set(load_tensors(tmp_path / "model.bin", "model")) == {"a"}
    monkeypatch.setattr(torch, "__version__", "2.5.1+cpu")
    with pytest.raises(InputError, match=r"torch 2\.5\.1.*2\.6 or later"):
        load_tensors(tmp_path / "model.bin", "model")


def test_the_prior(put, tmp_path):
    path = put("prior.safetensors")
    for read in (load_model, read_card, lambda path: models_without("Cats", path.parent)):
        with pytest.raises(InputError, match=r"prior\.safetensors"):
            read(path)


def test_checkpoints(put):
    with pytest.raises(InputError, match=r"state\.safetensors"):
        load_checkpoint(put("state.safetensors"))


def test_checkpoints_of_a_training_of_the_prior(put, tmp_path):
    sample = asset_sample(write_tube(tmp_path / "tube.npz"), "tube", 0, tmp_path)
    trainer = Trainer(SamplingPlan({"tubes": {"tube": [sample]}}), Schedule(steps=2))
    with pytest.raises(InputError, match=r"0\.checkpoint"):
        trainer.restore(put("m.0.checkpoint"))


def test_checkpoints_of_a_training_of_guidance(put):
    for name in (STATE, OLD_STATE):
        path = put(f"{name}.d/{name}")
        with pytest.raises(InputError, match=name):
            load_state(path.parent, {})


def test_samples(put, tmp_path):
    with pytest.raises(InputError, match=r"sample\.npz"):
        TrainingSample.load(put("sample.npz"))
    # In the cache such a file is no sample, and one is made in its place.
    cached = sample_file(put("x").parent, "tube", 0)
    shutil.copy(put("x"), cached)
    assert asset_sample(write_tube(tmp_path / "tube.npz"), "tube", 0, cached.parent) == cached
    TrainingSample.load(cached)


def test_assets(put, tmp_path):
    for read in (read_mesh_asset, lambda path: load_asset(path, 10)):
        with pytest.raises(InputError, match=r"asset\.npz"):
            read(put("asset.npz"))
    (tmp_path / "assets").mkdir()
    shutil.copy(put("catalog.json"), tmp_path / "assets" / "catalog.json")
    with pytest.raises(InputError, match="catalog"):
        list_assets(tmp_path / "assets")


def test_image_pairs(put, bomb):
    folder = put("shards/a.npz").parents[1]
    shutil.copy(put("x"), folder / "manifest.json")
    with pytest.raises(InputError, match=r"manifest\.json"):
        PairDataset(folder)
    shard = {"file": "a.npz", "asset": "a", "split": "train", "pairs": 1}
    manifest = {"version": 1, "settings": {"size": 8}, "assets": [], "shards": [shard]}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"a\.npz"):
        PairDataset(folder)[0]
    image = np.frombuffer(bomb, np.uint8)  # where the bytes of a picture should be
    mask = encode_image(np.ones((8, 8), bool))
    arrays = {"view": np.zeros(1), "rest_0": image, "posed_0": image, "mask_0": mask}
    np.savez(folder / "shards" / "a.npz", **arrays, handles_0=np.zeros((1, 2)), targets_0=np.zeros((1, 2)))
    with pytest.raises(InputError, match=r"a\.npz"):
        PairDataset(folder)[0]


@pytest.mark.parametrize("file", ["../a.npz", "/a.npz", "", 3])
def test_shards_lie_in_their_folder(tmp_path, file):
    shard = {"file": file, "asset": "a", "split": "train", "pairs": 1}
    (tmp_path / "manifest.json").write_text(
        json.dumps({"version": 1, "settings": {"size": 8}, "assets": [], "shards": [shard]})
    )
    with pytest.raises(InputError, match=r"manifest\.json"):
        PairDataset(tmp_path)


def test_other_files_of_models(put):
    with pytest.raises(InputError, match=r"config\.json"):
        read_table(put("config.json"))
    with pytest.raises(InputError, match=r"lpips\.pt"):
        load_lpips(str(put("lpips.pt")))


TINY = presets.Preset("for tests", 2, ((32, 4),), 4, held_out=0)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", TINY)
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 48)


@pytest.mark.parametrize("name", [optimise_loop.STATE, optimise_loop.OLD_STATE])
def test_the_checkpoint_of_a_job_is_put_aside_and_the_learning_starts_anew(put, tmp_path, small, name):
    limb = make_limb(200)
    settings = {"preset": "draft", "guidance": "elastic", "init": "visibility"}
    (tmp_path / "clean").mkdir()
    wanted = run(limb.cloud, limb.skeleton, settings, lambda *_: None, tmp_path / "clean")
    path = put(f"checkpoint/{name}")
    said = []
    found = run(limb.cloud, limb.skeleton, settings, lambda *news: said.append(news[3]), path.parent)
    np.testing.assert_array_equal(found.weights, wanted.weights)
    assert len([message for message in said if "starts anew" in message]) == 1
    assert not path.exists()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda state: {},
        lambda state: {**state, "optimiser": {}},
        lambda state: {**state, "optimiser": 3},
        lambda state: {**state, "optimiser": {**state["optimiser"], "iteration": 10**9}},
        lambda state: {**state, "optimiser": {**state["optimiser"], "iteration": -1}},
        lambda state: {**state, "optimiser": {**state["optimiser"], "rng": {"bit_generator": "os.system"}}},
        lambda state: {**state, "optimiser": {**state["optimiser"], "field": {"theta": torch.zeros(3)}}},
        lambda state: {**state, "optimiser": {**state["optimiser"], "stop": [1]}},
        lambda state: {**state, "history": [3]},
    ],
)
def test_a_checkpoint_that_does_not_fit_is_put_aside(tmp_path, small, monkeypatch, spoil):
    monkeypatch.setattr(optimise_loop, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(optimise_loop, "CHECKPOINT_SHARE", np.inf)
    limb = make_limb(200)
    settings = {"preset": "draft", "guidance": "elastic", "init": "visibility"}
    wanted = run(limb.cloud, limb.skeleton, settings, lambda *_: None, tmp_path)
    path = tmp_path / optimise_loop.STATE
    optimise_loop.save_checkpoint(path, spoil(load_checkpoint(path)))
    said = []
    found = run(limb.cloud, limb.skeleton, settings, lambda *news: said.append(news[3]), tmp_path)
    np.testing.assert_array_equal(found.weights, wanted.weights)
    assert any("cannot be used" in message for message in said)


def test_saved_guidance_images(bomb, tmp_path, monkeypatch):
    from gskin_addon.core.guidance.control import make_signals
    from gskin_addon.core.guidance.diffusion import DiffusionGuidance
    from gskin_addon.core.render.camera import paper_views

    limb = make_limb(100)
    signals = make_signals(limb.skeleton, paper_views(*limb.cloud.bounds(), 32)[:1], 1, np.random.default_rng(0))
    context = GuidanceContext(limb.cloud, limb.skeleton, limb.weights, limb.weights)

    class Painter:
        batch = 1

        def paint(self, frames, tick):
            return [frame.posed for frame in frames]

    kept = replace(context, checkpoint=tmp_path / "checkpoint")
    (whole,) = DiffusionGuidance(kept, Painter, {}).images(signals)
    (saved,) = (tmp_path / "checkpoint" / "guidance").glob("*.png")
    saved.write_bytes(bomb)
    (again,) = DiffusionGuidance(kept, Painter, {}).images(signals)
    np.testing.assert_array_equal(again, whole)


FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "yaml", "jsonpickle"}
FORBIDDEN_CALLS = {"eval", "exec", "os.system", "os.popen", "pickle.load", "pickle.loads", "compile"}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_module_reads_pickles_or_runs_text(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            assert not {name.split(".")[0] for name in names} & FORBIDDEN_MODULES, f"line {node.lineno}"
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            told = {word.arg: ast.unparse(word.value) for word in node.keywords}
            assert name not in FORBIDDEN_CALLS, f"line {node.lineno}"
            assert told.get("shell", "False") == "False", f"line {node.lineno}"
            if name == "torch.load":
                assert told.get("weights_only") == "True", f"line {node.lineno}"
            if name in ("np.load", "numpy.load"):
                assert told.get("allow_pickle") == "False", f"line {node.lineno}"
            if name == "Image.open":
                assert "formats" in told, f"line {node.lineno}"
