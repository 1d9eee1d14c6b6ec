# SPDX-License-Identifier: GPL-3.0-or-later
"""The common run of diffusion providers, with a painter that only pretends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gskin_addon.core.errors import Cancelled, GSkinError, InputError
from gskin_addon.core.guidance import diffusion
from gskin_addon.core.guidance.control import make_signals
from gskin_addon.core.guidance.diffusion import DiffusionGuidance, choose_offload, compute_device, noise
from gskin_addon.core.guidance.mask import painting_mask
from gskin_addon.core.guidance.provider import GuidanceContext, to_bytes
from gskin_addon.core.render.camera import paper_views
from gskin_addon.core.render.rasterizer import render_cloud
from gskin_addon.core.rig.lbs import skin_cloud
from tests.helpers.limb import make_limb


class NoisePainter:
    """Paints each frame with noise of its own seed, in three steps."""

    def __init__(self, batch: int = 3) -> None:
        self.batch = batch
        self.calls: list[list] = []

    def paint(self, frames, tick):
        self.calls.append([frame.signal for frame in frames])
        for step in range(3):
            tick((step + 1) / 3)
        return [noise(frame, frame.rest.shape).numpy() % 1.0 for frame in frames]


@pytest.fixture(scope="module")
def context():
    limb = make_limb(600)
    return GuidanceContext(limb.cloud, limb.skeleton, limb.weights, np.zeros_like(limb.weights), seed=4)


@pytest.fixture(scope="module")
def signals(context):
    cameras = paper_views(*context.cloud.bounds(), 64)
    return make_signals(context.skeleton, cameras, 4, np.random.default_rng(0))


def run(context, signals, painter, identity=None):
    return list(DiffusionGuidance(context, lambda: painter, identity or {"model": "a"}).images(signals))


def test_paints_inside_the_painting_mask_only(context, signals):
    painter = NoisePainter()
    images = run(context, signals, painter)
    assert len(images) == len(signals)
    for number, (signal, image) in enumerate(zip(signals, images, strict=True)):
        rest = render_cloud(context.cloud, signal.camera)[0]
        moved = skin_cloud(context.cloud, context.initial, signal.transforms, rotate_sh=False)
        mask = painting_mask(rest, render_cloud(moved, signal.camera)[0], signal.handles, signal.targets)
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image[~mask], to_bytes(rest)[~mask])
        seed = diffusion.image_seed(context.seed, number)
        painted = noise(diffusion.Frame(signal, rest, rest, mask, seed), rest.shape).numpy() % 1.0
        np.testing.assert_array_equal(image[mask], to_bytes(painted)[mask])


def test_batches_hold_one_view_and_do_not_matter(context, signals):
    painter = NoisePainter(batch=3)
    batched = run(context, signals, painter)
    assert max(len(call) for call in painter.calls) == 3
    assert all(len({signal.view for signal in call}) == 1 for call in painter.calls)
    single = run(context, signals, NoisePainter(batch=1))
    np.testing.assert_array_equal(batched, single)
    other = run(replace(context, seed=5), signals, NoisePainter())
    assert (np.array(other) != np.array(batched)).any()


def test_a_signal_that_moves_nothing_is_the_rest_view(context, signals):
    still = replace(signals[0], transforms=np.tile(np.eye(4), (context.skeleton.count, 1, 1)))
    painter = NoisePainter()
    (image,) = run(context, [still], painter)
    assert not painter.calls
    np.testing.assert_array_equal(image, to_bytes(render_cloud(context.cloud, still.camera)[0]))


def test_a_stopped_run_goes_on_with_the_images_that_are_finished(context, signals, tmp_path):
    whole = run(context, signals, NoisePainter())
    told = []

    def tick(done, message):
        told.append(done)
        if done > 0.5:
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        run(replace(context, checkpoint=tmp_path, tick=tick), signals, NoisePainter())
    assert told == sorted(told)
    finished = len(list((tmp_path / "guidance").glob("*.png")))
    assert 0 < finished < len(signals)
    painter = NoisePainter()
    resumed = run(replace(context, checkpoint=tmp_path), signals, painter)
    np.testing.assert_array_equal(resumed, whole)
    assert sum(map(len, painter.calls)) == len(signals) - finished

    def never():
        raise AssertionError("all images are there, the model must not be loaded")

    again = DiffusionGuidance(replace(context, checkpoint=tmp_path), never, {"model": "a"}).images(signals)
    np.testing.assert_array_equal(list(again), whole)


@pytest.mark.parametrize("change", ["model", "seed", "weights"])
def test_images_of_other_settings_are_not_taken(context, signals, tmp_path, change):
    kept = replace(context, checkpoint=tmp_path)
    run(kept, signals[:2], NoisePainter())
    identity = {"model": "b" if change == "model" else "a"}
    if change == "seed":
        kept = replace(kept, seed=9)
    if change == "weights":
        kept = replace(kept, initial=kept.initial[:, ::-1].copy())
    painter = NoisePainter()
    run(kept, signals[:2], painter, identity)
    assert sum(map(len, painter.calls)) == 2


def test_a_damaged_image_is_made_again(context, signals, tmp_path):
    kept = replace(context, checkpoint=tmp_path)
    whole = run(kept, signals[:3], NoisePainter())
    for path in (tmp_path / "guidance").glob("*.png"):
        path.write_bytes(path.read_bytes()[:200])
    np.testing.assert_array_equal(run(kept, signals[:3], NoisePainter()), whole)


def test_not_a_number_does_not_reach_the_loss(context, signals):
    class Broken(NoisePainter):
        def paint(self, frames, tick):
            return [np.full(frame.rest.shape, np.nan, np.float32) for frame in frames]

    with pytest.raises(GSkinError, match="not numbers; choose another dtype"):
        run(context, signals[:1], Broken())


def test_devices_and_off_loading():
    device, dtype = compute_device("cpu", "auto")
    assert (device.type, str(dtype)) == ("cpu", "torch.float32")
    assert str(compute_device("cpu", "bfloat16")[1]) == "torch.bfloat16"
    assert choose_offload("model", device, 99, 99) == "none"
    with pytest.raises(InputError, match="abacus"):
        compute_device("abacus", "auto")


def test_auto_off_loading_follows_the_memory(monkeypatch):
    import torch

    card = torch.device("cuda")
    for memory, expected in ((24, "none"), (12, "model"), (6, "sequential")):
        monkeypatch.setattr(diffusion, "device_memory", lambda device, memory=memory: memory)
        assert choose_offload("auto", card, resident=20, largest=10) == expected
    assert choose_offload("none", card, resident=20, largest=10) == "none"
