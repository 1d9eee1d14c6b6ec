# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of guidance models: from the panel to the job, and never to the network without consent."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

bpy = pytest.importorskip("bpy")

import pretend
import worker_jobs as jobs

import gskin_addon
from gskin_addon.core.job.contract import read_job
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.operators.auto_skin import GSKIN_OT_auto_skin
from gskin_addon.scene.splat_object import create_splat_object
from gskin_addon.session import guidance_settings, running_job, skin_job
from gskin_addon.ui import guidance


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A scene with chosen splats and armature, and a worker that only pretends."""
    with pretend.session(tmp_path, monkeypatch) as scene:
        scene.gskin.splats = create_splat_object(jobs.rod(200)[0], "Rod")
        scene.gskin.armature = pretend.add_armature()
        yield scene


@pytest.fixture
def online(monkeypatch):
    """Blender with online access, or without."""

    def switch(on: bool) -> None:
        monkeypatch.setattr(guidance_settings, "online", lambda: on)

    return switch


def options(scene) -> dict:
    return scene.gskin.as_job().get("options", {})


def test_guidance_without_a_model_has_no_options(scene):
    scene.gskin.models.flux_repair.model = "a/b"
    assert options(scene) == {}


def test_only_what_differs_from_the_defaults_goes_into_the_job(scene, tmp_path):
    scene.gskin.guidance = "flux_repair"
    flux = scene.gskin.models.flux_repair
    assert options(scene) == {}
    flux.model = "owner/name/"  # as the file browser's field may leave it
    flux.subject, flux.strength, flux.steps, flux.offload = "fox", 0.75, 8, "sequential"
    assert options(scene) == {
        "model": "owner/name", "subject": "fox", "strength": 0.75, "steps": 8, "offload": "sequential"
    }  # fmt: skip
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    flux.model = "//klein/"
    assert options(scene)["model"] == str(tmp_path / "klein")
    JobSettings.parse(scene.gskin.as_job())


def test_a_folder_beside_the_scene_raises_no_warning(scene, recwarn):
    scene.gskin.models.flux_repair.model = "//klein/"
    assert [str(warning.message) for warning in recwarn if "relative" in str(warning.message)] == []


def test_lightning_drag_takes_a_root_and_other_places(scene):
    scene.gskin.guidance = "lightning_drag"
    drag = scene.gskin.models.lightning_drag
    drag.models, drag.vae, drag.scheduler = "/models/", "stabilityai/sd-vae-ft-mse", "ddim"
    assert options(scene) == {"models": "/models", "vae": "stabilityai/sd-vae-ft-mse", "scheduler": "ddim"}
    JobSettings.parse(scene.gskin.as_job())


def test_defaults_of_the_panel_are_the_providers_own(scene):
    for name in ("flux2", "flux_repair", "lightning_drag"):
        scene.gskin.guidance = name
        assert options(scene) == {}
        JobSettings.parse(scene.gskin.as_job())


def test_consent_counts_only_with_online_access(scene, online):
    scene.gskin.guidance = "flux_repair"
    online(True)
    assert not scene.gskin.models.may_download()
    scene.gskin.models.allow_download = True
    assert scene.gskin.models.may_download()
    assert "allow_download" not in options(scene)  # what becomes job.json
    online(False)
    assert not scene.gskin.models.may_download()


def test_consent_comes_with_no_file_and_ends_with_the_add_on(scene, tmp_path):
    scene.gskin.models.allow_download = True
    path = str(tmp_path / "agreed.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    scene.gskin.models.allow_download = False
    bpy.ops.wm.open_mainfile(filepath=path)
    assert not bpy.context.scene.gskin.models.allow_download
    bpy.context.scene.gskin.models.allow_download = True
    gskin_addon.unregister()
    gskin_addon.register()
    assert not bpy.context.scene.gskin.models.allow_download


class Layout:
    """Writes down what is drawn."""

    def __init__(self, drawn=None) -> None:
        self.drawn = [] if drawn is None else drawn

    def prop(self, owner, name, **look) -> None:
        assert name in owner.bl_rna.properties
        self.drawn.append(name)

    def label(self, *, text, **look) -> None:
        self.drawn.append(text)

    def box(self):
        return Layout(self.drawn)

    def panel(self, name, **look):
        return Layout(self.drawn), Layout(self.drawn)


def drawn(scene) -> list[str]:
    layout = Layout()
    guidance.draw(layout, scene.gskin.models, scene.gskin.guidance)
    return layout.drawn


def test_the_panel_shows_the_chosen_guidances_settings(scene, online):
    online(True)
    assert drawn(scene) == []
    scene.gskin.guidance = "lightning_drag"
    assert {"models", "base", "lcm_lora", "scheduler", "steps"} <= set(drawn(scene))
    scene.gskin.models.lightning_drag.scheduler = "ddim"
    assert "lcm_lora" not in drawn(scene)
    scene.gskin.guidance = "flux_repair"
    assert drawn(scene) == ["model", "subject", "prompt", "strength", "steps", "offload"]
    scene.gskin.models.flux_repair.model = "black-forest-labs/FLUX.2-klein-4B"
    assert drawn(scene)[-1] == "allow_download"
    online(False)
    assert "Online access is off" in drawn(scene)[-1]


def test_online_access_is_blenders(scene):
    assert guidance_settings.online() == bpy.app.online_access


@pytest.mark.parametrize(
    ("model", "words"), [("", "No FLUX.2 .* is named"), ("/no/such/folder", "does not exist")]
)
def test_what_is_wrong_is_reported_before_a_worker_starts(scene, model, words, monkeypatch):
    monkeypatch.setattr(skin_job, "WorkerClient", lambda *args, **how: pytest.fail("started"))
    scene.gskin.guidance = "flux_repair"
    scene.gskin.models.flux_repair.model = model
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.gskin.auto_skin()
    assert running_job.state.failed


def test_the_worker_gets_the_options(scene, tmp_path, monkeypatch):
    (tmp_path / "klein").mkdir()
    scene.gskin.guidance = "flux_repair"
    scene.gskin.models.flux_repair.model = str(tmp_path / "klein")
    operator = SimpleNamespace(report=lambda kind, text: pytest.fail(text), chosen_rows=lambda context: None)
    assert GSKIN_OT_auto_skin._start(operator, bpy.context)
    job = operator._job
    assert read_job(job.client.folder).settings["options"] == {"model": str(tmp_path / "klein")}
    job.client.wait()
