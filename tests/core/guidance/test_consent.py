# SPDX-License-Identifier: GPL-3.0-or-later
"""The consent to a download goes with the process that is started, and stands in no file."""

from __future__ import annotations

import sys

import pytest
import worker_jobs as jobs

from gskin_addon.commands import parser, train_guidance
from gskin_addon.commands import rig as rig_command
from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance import consent
from gskin_addon.core.guidance.provider import GuidanceContext
from gskin_addon.core.job.contract import write_job
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.training.guidance import finetune
from gskin_addon.core.worker.client import WorkerClient
from tests.helpers.limb import make_limb

TELL = """
import json, os, sys
print(json.dumps({"stage": "told", "message": os.environ.get("GSKIN_ALLOW_DOWNLOAD", "nothing")}), flush=True)
print(json.dumps({"stage": "error", "error": "end", "traceback": "", "exit_code": 1}), flush=True)
sys.exit(1)
"""


def told_by(client):
    client.start()
    said = []
    while client.state == "running":
        said += [event.message for event in client.poll()]
    return said


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "tell.py"
    path.write_text(TELL)
    return path


@pytest.mark.parametrize("inherited", [None, "1", "0"])
@pytest.mark.parametrize("agreed", [False, True])
def test_the_worker_hears_of_it_from_its_client_only(tmp_path, program, monkeypatch, inherited, agreed):
    if inherited is not None:
        monkeypatch.setenv(consent.VARIABLE, inherited)
    client = WorkerClient(sys.executable, tmp_path, program, allow_download=agreed)
    assert told_by(client) == ["1" if agreed else "nothing"]


def test_without_a_word_there_is_none(tmp_path, program):
    assert told_by(WorkerClient(sys.executable, tmp_path, program)) == ["nothing"]


@pytest.mark.parametrize(("value", "given"), [("1", True), ("", False), ("0", False), ("yes", False)])
def test_only_one_value_agrees(monkeypatch, value, given):
    monkeypatch.setenv(consent.VARIABLE, value)
    assert consent.is_given() == given


@pytest.mark.parametrize("given", [False, True])
def test_the_providers_ask_for_it(monkeypatch, given):
    from gskin_addon.core.guidance import flux_repair, lightning_drag
    from gskin_addon.core.guidance.lightning_drag import files

    asked = []

    def find(name, what, *, allow_download=False, tell=None):
        asked.append(allow_download)
        raise InputError("enough")

    for module in (flux_repair, files):
        monkeypatch.setattr(module, "find_model", find)
    for module in (flux_repair, lightning_drag):
        monkeypatch.setattr(module, "require", lambda *_: None)
    if given:
        monkeypatch.setenv(consent.VARIABLE, "1")
    limb = make_limb(10)
    for module, name in ((flux_repair, "model"), (lightning_drag, "base")):
        context = GuidanceContext(limb.cloud, limb.skeleton, limb.weights, limb.weights, options={name: "owner/name"})
        with pytest.raises(InputError, match="enough"):
            module.create(context)
    assert asked == [given, given]


def test_a_file_that_agrees_does_not_count(tmp_path):
    options = {"model": "owner/name", "allow_download": True}
    folder = write_job(tmp_path / "job", *jobs.rod(), {"guidance": "flux_repair", "options": options})
    assert "allow_download" in (folder / "job.json").read_text()  # as gskin 0.1.0 wrote it, or somebody by hand
    with pytest.raises(InputError, match=r"allow_download.*nobody's files agree"):
        JobSettings.parse({"guidance": "flux_repair", "options": options})
    # Guidance that fetches nothing takes any options, and nobody asks for this one.
    JobSettings.parse({"guidance": "elastic", "options": {"allow_download": True}})
    assert not consent.is_given()


@pytest.mark.parametrize("agreed", [False, True])
def test_rig_keeps_it_out_of_the_settings(agreed):
    words = ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--guidance", "flux_repair"]
    words += ["--guidance-option", "model=owner/name", *(["--allow-download"] if agreed else [])]
    options = parser.build().parse_args(words)
    assert rig_command.guidance_options(options) == {"model": "owner/name"}


@pytest.mark.parametrize("agreed", [False, True])
def test_tuning_hears_of_it_beside_its_settings(tmp_path, monkeypatch, agreed):
    heard = []

    def tune(pairs, out, settings, report, *, allow_download=False):
        heard.append((settings, allow_download))
        return "done"

    monkeypatch.setattr(finetune, "tune", tune)
    words = ["train-guidance", "tune", str(tmp_path), "--out", str(tmp_path / "out"), "--option", "batch=2"]
    options = parser.build().parse_args([*words, *(["--allow-download"] if agreed else [])])
    train_guidance._tune(options, train_guidance.Reporter("tune", "none"))
    assert heard == [({"batch": 2}, agreed)]
