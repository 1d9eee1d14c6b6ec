# SPDX-License-Identifier: GPL-3.0-or-later
"""FLUX.2 [klein] with drawn skeletons, on a tiny pipeline of the real classes with random weights."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("diffusers")
pytest.importorskip("peft")

import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from tiny_flux import save_tiny_flux

from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.guidance import create_provider, flux2
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.diffusion import Frame
from gskin_addon.core.guidance.flux2 import LORA, Flux2Painter, references
from gskin_addon.core.guidance.options import Flux2Options, check_models, check_options
from gskin_addon.core.guidance.provider import GuidanceContext, to_bytes
from gskin_addon.core.guidance.skeleton_image import draw_bones, project_bones
from gskin_addon.core.pipeline import run as job
from gskin_addon.core.pipeline import steps
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.skinning import presets
from gskin_addon.core.training.guidance.flux2_options import Flux2TuneOptions
from gskin_addon.core.training.guidance.flux2_tune import trained_parameters, write_lora
from tests.helpers.limb import make_limb

SIZE = 64
WEIGHTS = "transformer/diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return save_tiny_flux(tmp_path_factory.mktemp("flux") / "klein")


@pytest.fixture(scope="module")
def painter(model):
    return Flux2Painter(model, Flux2Options(model=str(model), device="cpu", steps=2))


@pytest.fixture(scope="module")
def context(model):
    limb = make_limb(500)
    options = {"model": str(model), "device": "cpu", "steps": 2}
    return GuidanceContext(limb.cloud, limb.skeleton, limb.weights, np.zeros_like(limb.weights), options=options)


@pytest.fixture(scope="module")
def signals(context):
    cameras = paper_views(*context.cloud.bounds(), SIZE)[:1]
    return make_signals(context.skeleton, cameras, 2, np.random.default_rng(0))


@pytest.fixture(scope="module")
def frames(context, signals):
    rng = np.random.default_rng(0)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[5:20, 9:17] = True
    rest = rng.random((SIZE, SIZE, 3), np.float32)
    return [
        Frame(signal, rest, rest, mask, seed, project_bones(context.skeleton, signal.transforms, signal.camera))
        for seed, signal in enumerate(signals)
    ]


@pytest.fixture(scope="module")
def lora(model, tmp_path_factory):
    """A LoRA of random weights, which changes the pictures."""
    painter = Flux2Painter(model, Flux2Options(model=str(model), device="cpu"))
    options = Flux2TuneOptions(rank=2)
    torch.manual_seed(5)
    for value in trained_parameters(painter, options).values():
        value.data = torch.randn(value.shape)
    folder = tmp_path_factory.mktemp("lora")
    write_lora(painter, folder / LORA)
    return folder


def paint(painter, frames, tick=lambda done: None):
    return np.array(painter.paint(frames, tick))


def test_an_image_depends_on_its_seed_and_not_on_its_batch(painter, frames):
    done = []
    together = paint(painter, frames, done.append)
    assert together.shape == (2, SIZE, SIZE, 3)
    assert together.min() >= 0
    assert together.max() <= 1
    np.testing.assert_allclose(done, np.arange(1, 5) / 4)
    np.testing.assert_array_equal(paint(painter, frames[1:])[0], together[1])
    other = paint(painter, [replace(frames[0], seed=77)])
    assert np.abs(other[0] - together[0])[frames[0].mask].max() > 0.01


def test_rest_view_and_both_skeletons_are_seen(painter, frames):
    seen, bones = paint(painter, frames[:1]), frames[0].bones
    for changed in (
        replace(frames[0], rest=1 - frames[0].rest),
        replace(frames[0], bones=replace(bones, rest=bones.posed)),
        replace(frames[0], bones=replace(bones, posed=bones.rest)),
    ):
        assert np.abs(seen - paint(painter, [changed]))[0][frames[0].mask].max() > 1e-4


def test_the_pictures_that_the_pipeline_gets(painter, frames, monkeypatch):
    given = []
    call = painter._pipeline

    class Listener:
        def __getattr__(self, name):
            return getattr(call, name)

        def __call__(self, **how):
            given.append([np.array(image) for image in how["image"]])
            return call(**how)

    monkeypatch.setattr(painter, "_pipeline", Listener())
    paint(painter, frames[:1])
    bones = frames[0].bones
    rest, still, moved = given[0]
    np.testing.assert_array_equal(rest, to_bytes(frames[0].rest))
    np.testing.assert_array_equal(still, draw_bones(bones.rest, bones.bone, (SIZE, SIZE)))
    np.testing.assert_array_equal(moved, draw_bones(bones.posed, bones.bone, (SIZE, SIZE)))
    assert (still != moved).any()


def test_only_the_masked_tokens_are_painted(painter, frames, monkeypatch):
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
    pixels = torch.from_numpy(to_bytes(frames[0].rest)).permute(2, 0, 1)[None] / 127.5 - 1
    with torch.no_grad():
        own = painter._pipeline.vae.encode(pixels).latent_dist.mode()
    np.testing.assert_allclose(latents[0].numpy()[..., ~inside], own.numpy()[..., ~inside], atol=1e-4)


def test_cancel_between_denoising_steps(painter, frames):
    done = []

    def tick(part):
        done.append(part)
        if len(done) == 2:
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        paint(painter, frames, tick)
    assert len(done) == 2


def test_an_undistilled_model_is_guided_by_the_prompt(tmp_path, frames):
    model = save_tiny_flux(tmp_path / "base", is_distilled=False)
    options = Flux2Options(model=str(model), device="cpu", steps=2)
    weak, strong = (Flux2Painter(model, replace(options, guidance_scale=scale)) for scale in (1.0, 9.0))
    assert weak._empty is None
    assert np.abs(paint(weak, frames[:1]) - paint(strong, frames[:1])).max() > 1e-3


def test_the_provider_makes_images_and_goes_on_after_a_stop(context, signals, painter, tmp_path, monkeypatch):
    whole = list(create_provider("flux2", context).images(signals))
    monkeypatch.setattr(flux2, "Flux2Painter", lambda folder, options: painter)  # loaded already
    for image, signal in zip(whole, signals, strict=True):
        differs = (image != to_bytes(render_cloud(context.cloud, signal.camera)[0])).any(-1)
        assert 0 < differs.sum() < 0.9 * differs.size

    def tick(done, message):
        if done > 0.6:
            raise Cancelled("stop")

    kept = replace(context, checkpoint=tmp_path)
    with pytest.raises(Cancelled):
        list(create_provider("flux2", replace(kept, tick=tick)).images(signals))
    assert len(list((tmp_path / "guidance").glob("*.png"))) == 1
    np.testing.assert_array_equal(list(create_provider("flux2", kept).images(signals)), whole)
    # Another skeleton is another picture, though nothing else of the job changes.
    bones = context.skeleton
    other = replace(kept, skeleton=replace(bones, tails=bones.tails + 0.05))
    list(create_provider("flux2", other).images(signals[:1]))
    assert len(list((tmp_path / "guidance").glob("*.png"))) == 3


def test_a_lora_changes_the_pictures(model, painter, lora, frames):
    tuned = Flux2Painter(model, Flux2Options(model=str(model), device="cpu", lora=str(lora), steps=2))
    assert np.abs(paint(tuned, frames[:1]) - paint(painter, frames[:1])).max() > 1e-3


def test_whole_jobs_with_and_without_a_lora(model, lora, tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", presets.Preset("for tests", 1, ((64, 6),), 2, held_out=0))
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 64)
    limb, pictures = make_limb(400), []
    for name, more in (("plain", {}), ("tuned", {"lora": str(lora)})):
        folder, told = tmp_path / name, []
        folder.mkdir()
        options = {"model": str(model), "device": "cpu", "steps": 2, **more}
        settings = {"preset": "draft", "guidance": "flux2", "options": options}
        outcome = job.run(limb.cloud, limb.skeleton, settings, lambda *what, told=told: told.append(what), folder)
        assert outcome.weights.shape == limb.weights.shape
        np.testing.assert_allclose(outcome.weights.sum(1), 1, atol=1e-5)
        assert outcome.report["guidance_images"] == 4
        assert any(message == "Loading FLUX.2 [klein]" for _, _, _, message, *_ in told)
        made = sorted((folder / "guidance").glob("*.png"))
        assert len(made) == 4
        pictures.append({np.asarray(Image.open(path)).tobytes() for path in made})
    assert not pictures[0] & pictures[1], "the LoRA changes every picture"


# --- what is refused


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"batch": 2}, "batch of 'flux2' is 2"),
        ({"strength": 0.5}, "no option 'strength'"),
        ({"guidance_scale": 0.5}, "between 1.0 and 30.0"),
        ({"prompt": 3}, "must be text"),
    ],
)
def test_wrong_options(values, words):
    with pytest.raises(InputError, match=words):
        check_options("flux2", values)


def test_a_lora_is_a_model_that_must_be_there(model, tmp_path):
    check_models("flux2", {"model": str(model)})
    with pytest.raises(InputError, match=r"folder of the LoRA .*'.*none', does not exist"):
        check_models("flux2", {"model": str(model), "lora": str(tmp_path / "none")})


def test_frames_without_bones_and_odd_sizes(painter, frames):
    with pytest.raises(InputError, match="hold no skeletons"):
        references(to_bytes(frames[0].rest), None)
    odd = replace(frames[0], rest=frames[0].rest[:62], mask=frames[0].mask[:62])
    with pytest.raises(InputError, match="64 x 62 pixels; take multiples of 4 from 64 on"):
        paint(painter, [odd])
    with pytest.raises(InputError, match="32 x 64 pixels"):
        flux2.check_size((64, 32), 4)


@pytest.fixture
def copy(model, tmp_path):
    return shutil.copytree(model, tmp_path / "copy")


def refused(folder, **options):
    context = GuidanceContext(None, None, None, None, options={"model": str(folder), "device": "cpu", **options})
    with pytest.raises(InputError) as caught:
        create_provider("flux2", context)
    return str(caught.value)


def test_missing_and_other_files_are_named(copy, tmp_path):
    assert "No FLUX.2 [klein] model is named" in refused("")
    assert f"'{tmp_path / LORA}' does not exist" in refused(copy, lora=str(tmp_path))
    index = json.loads((copy / "model_index.json").read_text())
    (copy / "model_index.json").write_text(json.dumps({**index, "_class_name": "StableDiffusionPipeline"}))
    assert "StableDiffusionPipeline, not a FLUX.2" in refused(copy)
    (copy / WEIGHTS).unlink()
    said = refused(copy)
    assert "lacks 'transformer/" in said
    assert "licence: Apache-2.0" in said


def test_weights_that_are_cut_off_or_lack_a_tensor(copy):
    options, path = Flux2Options(model=str(copy), device="cpu"), copy / WEIGHTS
    state = load_file(path)
    save_file({key: value for key, value in state.items() if key != "proj_out.weight"}, path, {"format": "pt"})
    with pytest.raises(InputError, match=r"copy.*proj_out\.weight"):
        Flux2Painter(copy, options)
    whole = {**state, "proj_out.weight": torch.full_like(state["proj_out.weight"], float("nan"))}
    save_file(whole, path, {"format": "pt"})
    with pytest.raises(InputError, match=r"transformer in .*'proj_out\.weight' that are not finite"):
        Flux2Painter(copy, options)
    save_file({**state, "one_more.weight": torch.zeros(2)}, path, {"format": "pt"})
    with pytest.raises(InputError, match=r"transformer in .* has no place for 'one_more\.weight'"):
        Flux2Painter(copy, options)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="does not load"):
        Flux2Painter(copy, options)


def test_loras_that_do_not_fit_are_named(model, lora, tmp_path):
    options, path = Flux2Options(model=str(model), device="cpu", lora=str(tmp_path)), tmp_path / LORA
    state = load_file(lora / LORA)
    key = next(iter(state))

    def said(changed):
        save_file(changed, path)
        with pytest.raises(InputError) as caught:
            Flux2Painter(model, options)
        assert str(path) in str(caught.value)
        return str(caught.value)

    assert "'unet.weight' of another model" in said({**state, "unet.weight": torch.zeros(2)})
    assert "does not fit" in said({**state, key: torch.zeros(3, 5)})
    other = key.replace("blocks.0", "blocks.7")
    assert other != key
    assert "blocks.7" in said({other if name == key else name: value for name, value in state.items()})
    assert "is empty" in said({})
    assert "not finite" in said({**state, key: torch.full_like(state[key], float("inf"))})
    assert "as int8, as quantised models" in said({**state, key: state[key].to(torch.int8)})
    path.write_bytes((lora / LORA).read_bytes()[:300])
    with pytest.raises(InputError, match="cannot be read as plain weights"):
        Flux2Painter(model, options)
