# SPDX-License-Identifier: GPL-3.0-or-later
"""Render and repair, on a tiny pipeline of the real classes with random weights."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("diffusers")

from safetensors.torch import load_file, save_file
from tiny_flux import save_tiny_flux

from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.guidance import create_provider, flux_repair
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.diffusion import Frame
from gskin_addon.core.guidance.flux_repair import FluxPainter, whole_tokens
from gskin_addon.core.guidance.options import FluxOptions
from gskin_addon.core.guidance.provider import GuidanceContext, to_bytes
from gskin_addon.core.pipeline import steps as pipeline_steps
from gskin_addon.core.pipeline.run import run
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.skinning import presets
from tests.helpers.limb import make_limb

SIZE = 32


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return save_tiny_flux(tmp_path_factory.mktemp("flux") / "klein")


@pytest.fixture(scope="module")
def painter(model):
    return FluxPainter(model, FluxOptions(model=str(model), device="cpu"))


@pytest.fixture(scope="module")
def frames():
    rng = np.random.default_rng(0)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[5:20, 9:17] = True
    images = rng.random((3, 2, SIZE, SIZE, 3), np.float32)
    return [Frame(None, rest, posed, mask, seed) for seed, (rest, posed) in enumerate(images)]


@pytest.fixture(scope="module")
def context(model):
    limb = make_limb(500)
    options = {"model": str(model), "device": "cpu", "batch": 3}
    return GuidanceContext(limb.cloud, limb.skeleton, limb.weights, np.zeros_like(limb.weights), options=options)


def paint(painter, frames, tick=lambda done: None):
    return np.array(painter.paint(frames, tick))


def test_an_image_depends_on_its_seed_and_not_on_its_batch(painter, frames):
    together = paint(painter, frames)
    assert together.shape == (3, SIZE, SIZE, 3)
    assert together.min() >= 0
    assert together.max() <= 1
    alone = np.concatenate([paint(painter, [frame]) for frame in frames])
    assert np.abs(to_bytes(together).astype(int) - to_bytes(alone)).max() <= 1
    again = paint(painter, frames[:1])
    np.testing.assert_array_equal(again[0], alone[0])
    other = paint(painter, [replace(frames[0], seed=77)])
    assert np.abs(other[0] - alone[0])[frames[0].mask].max() > 0.01


def test_the_rest_view_is_the_reference(painter, frames):
    seen = paint(painter, frames[:1])
    other = paint(painter, [replace(frames[0], rest=frames[1].rest)])
    assert np.abs(seen - other)[0][frames[0].mask].max() > 1e-4


def test_only_the_masked_tokens_are_repainted(painter, frames, monkeypatch):
    latents = []
    decode = painter._pipeline.vae.decode
    monkeypatch.setattr(painter._pipeline.vae, "decode", lambda z, **how: latents.append(z) or decode(z, **how))
    mask = np.zeros((SIZE, SIZE), bool)
    mask[7, 9:13] = True  # of the tokens of 4 pixels, row 1 and columns 2 and 3
    for seed in (1, 2):
        paint(painter, [replace(frames[0], mask=mask, seed=seed)])
    change = (latents[0] - latents[1]).abs().amax(dim=(0, 1)).numpy()  # two latent pixels to a token's side
    inside = np.zeros(change.shape, bool)
    inside[2:4, 4:8] = True
    assert change[inside].min() > 1e-3
    assert change[~inside].max() == 0


def test_strength_decides_how_many_steps_are_run(model, painter, frames):
    for strength, steps, expected in ((0.6, 0, 3), (1.0, 0, 4), (1.0, 7, 7), (0.01, 0, 1)):
        done = []
        painter._options = FluxOptions(strength=strength)
        painter._steps = steps or 4
        paint(painter, frames[:2], done.append)
        np.testing.assert_allclose(done, np.arange(1, expected + 1) / expected)
    painter._options, painter._steps = FluxOptions(), 4


def test_cancel_between_denoising_steps(painter, frames):
    done = []

    def tick(part):
        done.append(part)
        if len(done) == 2:
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        paint(painter, frames, tick)
    assert len(done) == 2


def test_the_prompt_is_heard_and_the_text_encoder_dropped(model, painter):
    other = FluxPainter(model, FluxOptions(model=str(model), device="cpu", subject="zebra"))
    assert not np.allclose(other._prompt.numpy(), painter._prompt.numpy())
    assert other._prompt.shape[:2] == (1, 512)
    assert other._pipeline.text_encoder is None
    assert painter._empty is None  # a distilled model takes no guidance


def test_an_undistilled_model_is_guided_by_the_prompt(tmp_path, frames):
    model = save_tiny_flux(tmp_path / "base", is_distilled=False)
    options = FluxOptions(model=str(model), device="cpu", steps=2)
    weak = FluxPainter(model, replace(options, guidance_scale=1.0))
    strong = FluxPainter(model, replace(options, guidance_scale=9.0, steps=0))
    assert (weak._steps, strong._steps) == (2, 50)
    strong._steps = 2
    assert weak._empty is None
    assert strong._empty is not None
    assert np.abs(paint(weak, frames[:1]) - paint(strong, frames[:1])).max() > 1e-3


def test_off_loading_one_model_at_a_time_paints_the_same(model, painter, frames, monkeypatch):
    """With accelerate's hooks, though to the processor: there is no GPU here."""
    monkeypatch.setattr(flux_repair, "choose_offload", lambda *memory: "model")
    options = FluxOptions(model=str(model), device="cpu", offload="model")
    np.testing.assert_array_equal(paint(FluxPainter(model, options), frames[:1]), paint(painter, frames[:1]))


def test_the_provider_makes_images_and_goes_on_after_a_stop(context, painter, tmp_path, monkeypatch):
    cameras = paper_views(*context.cloud.bounds(), SIZE)
    signals = make_signals(context.skeleton, cameras, 3, np.random.default_rng(0))[:6]
    told = []

    def tick(done, message):
        told.append((done, message))
        if done > 0.7:
            raise Cancelled("stop")

    whole = list(create_provider("flux_repair", context).images(signals))
    monkeypatch.setattr(flux_repair, "FluxPainter", lambda folder, options: painter)  # loaded already
    monkeypatch.setattr(painter, "batch", 3)
    for image, signal in zip(whole, signals, strict=True):
        rest = to_bytes(render_cloud(context.cloud, signal.camera)[0])
        assert image.shape == (SIZE, SIZE, 3)
        differs = (image != rest).any(-1)
        assert 0 < differs.sum() < 0.9 * differs.size
    kept = replace(context, checkpoint=tmp_path)
    with pytest.raises(Cancelled):
        list(create_provider("flux_repair", replace(kept, tick=tick)).images(signals))
    assert len(list((tmp_path / "guidance").glob("*.png"))) == 3  # one batch of one view
    assert [message for _, message in told][:2] == ["Guidance image 1 of 6", "Loading FLUX.2 [klein]"]
    assert told[2][0] == pytest.approx(1 / 6)  # a third of the first three images, after one of three steps
    np.testing.assert_array_equal(list(create_provider("flux_repair", kept).images(signals)), whole)


def test_a_whole_job(model, painter, tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", presets.Preset("for tests", 2, ((16, 4), (32, 4)), 2, held_out=0))
    monkeypatch.setattr(pipeline_steps, "GUIDANCE_SIZE", SIZE)
    monkeypatch.setattr(flux_repair, "FluxPainter", lambda folder, options: painter)  # loaded already
    limb = make_limb(500)
    settings = {"preset": "draft", "guidance": "flux_repair", "options": {"model": str(model), "device": "cpu"}}
    told = []

    def progress(stage, fraction, losses=None, message="", *more):
        told.append((stage, fraction, message))

    outcome = run(limb.cloud, limb.skeleton, settings, progress, tmp_path)
    assert outcome.report["guidance_images"] == len(list((tmp_path / "guidance").glob("*.png"))) == 8
    np.testing.assert_allclose(outcome.weights.sum(1), 1, atol=1e-5)
    messages = [message for stage, _, message in told if stage == "guidance"]
    assert messages.count("Guidance image 1 of 8") > 2  # news between the denoising steps


def test_the_mask_is_grown_to_whole_tokens():
    mask = np.zeros((10, 12), bool)
    mask[3, 4] = mask[9, 11] = True
    grown = whole_tokens(mask, 4)
    expected = np.zeros((10, 12), bool)
    expected[0:4, 4:8] = expected[8:10, 8:12] = True
    np.testing.assert_array_equal(grown, expected)


# --- wrong files


@pytest.fixture
def copy(model, tmp_path):
    return shutil.copytree(model, tmp_path / "copy")


def refused(folder, **options):
    context = GuidanceContext(None, None, None, None, options={"model": str(folder), "device": "cpu", **options})
    with pytest.raises(InputError) as caught:
        create_provider("flux_repair", context)
    return str(caught.value)


@pytest.mark.parametrize(
    "lost",
    [
        "model_index.json",
        "transformer/diffusion_pytorch_model.safetensors",
        "vae/config.json",
        "text_encoder/model.safetensors",
        "tokenizer/tokenizer.json",
    ],
)
def test_a_missing_file_is_named(copy, lost):
    (copy / lost).unlink()
    said = refused(copy)
    assert lost.split("/")[0] in said
    assert "licence: Apache-2.0" in said


def test_another_pipeline_is_refused_by_name(copy):
    index = json.loads((copy / "model_index.json").read_text())
    (copy / "model_index.json").write_text(json.dumps({**index, "_class_name": "StableDiffusionPipeline"}))
    assert "StableDiffusionPipeline, not a FLUX.2" in refused(copy)
    (copy / "model_index.json").write_text(json.dumps({**index, "transformer": ["my_code", "MyTransformer"]}))
    assert "transformer MyTransformer" in refused(copy)
    (copy / "model_index.json").write_text("[]")
    assert "does not describe" in refused(copy)


def test_nothing_named_and_no_such_device(model):
    assert "No FLUX.2 [klein] model is named" in refused("")
    assert "'abacus' cannot be used" in refused(model, device="abacus")


def test_damaged_weights_are_told_when_they_are_loaded(copy):
    path = copy / "transformer" / "diffusion_pytorch_model.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="does not load"):
        FluxPainter(copy, FluxOptions(model=str(copy), device="cpu"))


@pytest.mark.parametrize(
    ("part", "file", "key"),
    [
        ("transformer", "diffusion_pytorch_model", "proj_out.weight"),
        ("vae", "diffusion_pytorch_model", "bn.running_mean"),
        ("text_encoder", "model", "model.layers.3.mlp.up_proj.weight"),
    ],
)
def test_a_missing_tensor_is_named(copy, part, file, key):
    path = copy / part / f"{file}.safetensors"
    save_file({name: value for name, value in load_file(path).items() if name != key}, path, {"format": "pt"})
    with pytest.raises(InputError, match=rf"The {part} in '.*copy' lacks the tensor '{key}'"):
        FluxPainter(copy, FluxOptions(model=str(copy), device="cpu"))


def test_pickled_weights_are_not_read(copy):
    path = copy / "vae" / "diffusion_pytorch_model.safetensors"
    path.rename(path.with_suffix(".bin"))
    assert "vae/*.safetensors" in refused(copy)
    assert "safetensors" in str(flux_repair.FILES.needs)
