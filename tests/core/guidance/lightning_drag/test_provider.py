# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import copy
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("diffusers")

from gskin_addon.core.errors import Cancelled, InputError
from gskin_addon.core.guidance import create_provider
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.diffusion import Frame, image_seed
from gskin_addon.core.guidance.lightning_drag import weights
from gskin_addon.core.guidance.lightning_drag.files import find_files
from gskin_addon.core.guidance.lightning_drag.image_tokens import CLIP_MEAN, CLIP_STD, clip_pixels
from gskin_addon.core.guidance.lightning_drag.pipeline import LightningDragPainter, Schedule, add_noise
from gskin_addon.core.guidance.options import LightningDragOptions
from gskin_addon.core.guidance.provider import GuidanceContext, to_bytes
from gskin_addon.core.pipeline import run as job
from gskin_addon.core.pipeline import steps
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.skinning import presets
from tests.helpers.limb import make_limb

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def model(models):
    return weights.load(find_files(LightningDragOptions(models=str(models))), torch.float32)


@pytest.fixture(scope="module")
def context(models):
    limb = make_limb(500)
    options = {"models": str(models), "steps": 2, "batch": 2}
    return GuidanceContext(
        limb.cloud, limb.skeleton, limb.weights, np.zeros_like(limb.weights), options=options, seed=3
    )


@pytest.fixture(scope="module")
def signals(context):
    cameras = paper_views(*context.cloud.bounds(), 64)[:2]
    return make_signals(context.skeleton, cameras, 3, np.random.default_rng(0))


@pytest.fixture(scope="module")
def frames(context, signals):
    mask = np.zeros((64, 64), bool)
    mask[10:50, 16:40] = True
    rest = render_cloud(context.cloud, signals[0].camera)[0]
    return [Frame(signal, rest, rest, mask, image_seed(0, i)) for i, signal in enumerate(signals[:3])]


def painter(model, kind="lcm", steps=2, **settings):
    return LightningDragPainter(model, Schedule.of(kind, steps), device=CPU, dtype=torch.float32, **settings)


def silent(_done):
    return None


def test_schedules_are_the_published_ones():
    assert Schedule.of("lcm") == Schedule("lcm", 8, 3.0)
    assert Schedule.of("ddim") == Schedule("ddim", 25, 4.0)
    assert [Schedule.of("lcm").scale_at(i) for i in (0, 4)] == [3.0, 1.5]
    config = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear", "steps_offset": 1}
    lcm = Schedule.of("lcm").scheduler(config, CPU)
    assert (type(lcm).__name__, int(lcm.timesteps[0]), len(lcm.timesteps)) == ("LCMScheduler", 999, 8)
    ddim = Schedule.of("ddim").scheduler({**config, "_class_name": "PNDMScheduler", "skip_prk_steps": True}, CPU)
    assert (type(ddim).__name__, int(ddim.timesteps[-1]), len(ddim.timesteps)) == ("DDIMScheduler", 1, 25)
    alpha = (1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000).double() ** 2).prod().float()
    source, noise = torch.randn(1, 4, 8, 8), torch.randn(2, 4, 8, 8)
    torch.testing.assert_close(add_noise(lcm, source, noise), alpha.sqrt() * source + (1 - alpha).sqrt() * noise)


@pytest.mark.parametrize("kind", ["lcm", "ddim"])
def test_an_image_depends_on_its_own_frame_only(model, frames, kind):
    together = painter(model, kind).paint(frames, silent)
    alone = [painter(model, kind).paint([frame], silent)[0] for frame in frames]
    np.testing.assert_allclose(together, alone, atol=1e-5)
    assert np.abs(together[0] - together[1]).max() > 0.1
    again = painter(model, kind).paint(frames, silent)
    np.testing.assert_array_equal(together, again)
    other = painter(model, kind).paint([replace(frames[0], seed=99)], silent)
    assert np.abs(other[0] - together[0]).max() > 0.1


def test_the_scale_of_guidance_weighs_the_points_and_nothing_else(model, frames):
    def paint(model, scale):
        brush = LightningDragPainter(model, Schedule("lcm", 2, scale), device=CPU, dtype=torch.float32)
        return brush.paint(frames[:1], silent)[0]

    assert np.abs(paint(model, 1.0) - paint(model, 5.0)).max() > 1e-3
    numb = copy.deepcopy(model)
    for processor in numb.processors[::2]:
        processor.proj.weight.zero_()
    assert np.abs(paint(model, 1.0) - paint(numb, 1.0)).max() > 1e-3
    np.testing.assert_allclose(paint(numb, 1.0), paint(numb, 5.0), atol=1e-5)


def test_points_are_thinned_as_asked(model, frames):
    signal = replace(
        frames[0].signal,
        handles=np.array([[20.0, 20], [30, 30], [40, 30]]),
        targets=np.array([[22.0, 20], [30, 55], [41, 30]]),
    )
    frame, one = replace(frames[0], signal=signal), replace(signal, handles=signal.handles[[1]])
    few = painter(model, max_points=1).paint([frame], silent)[0]
    only = replace(frame, signal=replace(one, targets=signal.targets[[1]]))
    np.testing.assert_array_equal(few, painter(model).paint([only], silent)[0])
    assert np.abs(few - painter(model).paint([frame], silent)[0]).max() > 1e-3


def test_encoders_run_once_per_view(model, frames, monkeypatch):
    passes = []
    hook = model.appearance.register_forward_pre_hook(lambda *_: passes.append(1))
    brush = painter(model)
    for frame in frames:
        brush.paint([frame], silent)
    brush.paint([replace(frames[0], signal=replace(frames[0].signal, view=1))], silent)
    hook.remove()
    assert len(passes) == 2


def test_off_loading_moves_the_encoders_only_for_their_pass(model, frames, monkeypatch):
    """On a CPU nothing moves in truth, so the calls are watched."""
    moves = []
    for module in (*model.encoders, *model.denoisers):
        monkeypatch.setattr(module, "to", lambda device, module=module: moves.append((module, str(device))))
    brush = painter(model, offload=True)
    assert [module for module, _ in moves] == list(model.denoisers)
    moves.clear()
    brush.paint(frames[:1], silent)
    brush.paint(frames[1:2], silent)
    assert [module for module, _ in moves] == list(model.encoders) * 2


@pytest.mark.parametrize(("dtype", "off"), [(torch.float16, 0.01), (torch.bfloat16, 0.08)])
def test_half_precision_paints_the_same_picture_coarsely(models, model, frames, dtype, off):
    """In a batch, off-loaded: what a small GPU would run, as far as a CPU can."""
    half = weights.load(find_files(LightningDragOptions(models=str(models))), dtype)
    brush = LightningDragPainter(
        half, Schedule.of("lcm", 2), device=CPU, dtype=dtype, batch=len(frames), offload=True
    )
    seen = []
    hooks = [
        module.register_forward_pre_hook(lambda _module, given: seen.append(given[0].dtype))
        for module in (half.unet, half.appearance, half.image_encoder, half.point_embedding)
    ]
    images = np.array(brush.paint(frames, silent))
    for hook in hooks:
        hook.remove()
    assert set(seen) == {dtype}
    assert images.dtype == np.float32
    wanted = np.array(painter(model).paint(frames, silent))
    assert np.isfinite(images).all()
    assert 0 < np.abs(images - wanted).mean() < off
    alone = [brush.paint([frame], silent)[0] for frame in frames]
    assert np.abs(images - alone).mean() < off / 2


def test_sizes_that_the_model_cannot_take_are_refused(model, frames):
    small = replace(frames[0], mask=np.ones((96, 64), bool))
    with pytest.raises(InputError, match="multiples of 64, not 64 x 96"):
        painter(model).paint([small], silent)


def test_clip_sees_the_middle_of_the_image():
    image = np.zeros((64, 128, 3), np.float32)
    image[:, 32:96] = (1.0, 0.5, 0.0)
    pixels = clip_pixels(image, 28)
    assert pixels.shape == (1, 3, 28, 28)
    colour = (np.array([1.0, 128 / 255, 0.0]) - CLIP_MEAN) / CLIP_STD
    np.testing.assert_allclose(pixels[0, :, 5:23, 5:23], np.broadcast_to(colour[:, None, None], (3, 18, 18)), atol=1e-5)


def test_images_are_composited_outside_the_mask_and_resumed(context, signals, tmp_path, monkeypatch):
    whole = list(create_provider("lightning_drag", context).images(signals))
    assert len(whole) == 6
    for signal, image in zip(signals, whole, strict=True):
        rest = to_bytes(render_cloud(context.cloud, signal.camera)[0])
        same = (image == rest).all(axis=-1)
        assert same[0].all()  # the frame's border never moves
        assert 0.02 < (~same).mean() < 0.9

    told = []

    def tick(done, message):
        told.append((done, message))
        if done > 0.6:
            raise Cancelled("stop")

    stopped = replace(context, checkpoint=tmp_path, tick=tick)
    with pytest.raises(Cancelled):
        list(create_provider("lightning_drag", stopped).images(signals))
    done = [part for part, _ in told]
    assert done == sorted(done)
    assert len({part for part in done if part > 0}) >= 4  # told at every denoising step
    assert len(list((tmp_path / "guidance").glob("*.png"))) == 3
    painted = []
    original = LightningDragPainter.paint
    monkeypatch.setattr(
        LightningDragPainter, "paint", lambda self, frames, tick: painted.extend(frames) or original(self, frames, tick)
    )
    resumed = list(create_provider("lightning_drag", replace(context, checkpoint=tmp_path)).images(signals))
    np.testing.assert_allclose(np.array(resumed, int), np.array(whole, int), atol=1)
    assert len(painted) == 3


def test_another_checkpoint_makes_new_images(context, signals, models, tmp_path):
    mine = shutil.copytree(models / "lightning_drag", tmp_path / "other")
    kept = replace(context, checkpoint=tmp_path)
    list(create_provider("lightning_drag", kept).images(signals[:2]))
    options = {**context.options, "lightning_drag": str(mine)}
    (mine / "fine_tuned.json").write_text(json.dumps({"max_points": 0}))
    list(create_provider("lightning_drag", replace(kept, options=options)).images(signals[:2]))
    assert len(list((tmp_path / "guidance").glob("*.png"))) == 4


def test_a_whole_job(models, tmp_path, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "draft", presets.Preset("for tests", 1, ((64, 6),), 2, held_out=0))
    monkeypatch.setattr(steps, "GUIDANCE_SIZE", 64)
    limb = make_limb(400)
    stages = []
    settings = {
        "preset": "draft",
        "guidance": "lightning_drag",
        "options": {"models": str(models), "scheduler": "ddim", "steps": 2, "max_points": 1},
    }
    outcome = job.run(limb.cloud, limb.skeleton, settings, lambda *what: stages.append(what), tmp_path)
    assert outcome.weights.shape == limb.weights.shape
    np.testing.assert_allclose(outcome.weights.sum(1), 1, atol=1e-5)
    assert outcome.report["guidance_images"] == 4
    points = outcome.report["control_points"]
    assert (points["limit"], points["images"], points["dropped"]) == (1, 4, points["points"] - 4)
    assert points["dropped"] > 0
    assert any("are left out (option max_points)" in message for _, _, _, message, *_ in stages)
    assert any(message == "Loading LightningDrag" for _, _, _, message, *_ in stages)


def test_a_job_without_models_says_what_to_bring(tmp_path):
    limb = make_limb(50)
    settings = {"preset": "draft", "guidance": "lightning_drag"}
    with pytest.raises(InputError, match="No base inpainting model is named"):
        job.run(limb.cloud, limb.skeleton, settings, lambda *_: None, tmp_path)
