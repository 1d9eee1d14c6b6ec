# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line without Blender: options, exit codes, one sentence per error, and drawing a .ply."""

from __future__ import annotations

import dataclasses
import errno
import io
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import worker_jobs as jobs
from PIL import Image
from splat_clouds import random_cloud

import gskin_addon
from gskin_addon import cli
from gskin_addon.commands import parser, render, rig
from gskin_addon.commands.job_settings import job_settings, warning_of_no_guidance
from gskin_addon.commands.pose import parse_turns
from gskin_addon.core.errors import Cancelled, GSkinError, InputError, Stopped
from gskin_addon.core.job.progress import ProgressEvent
from gskin_addon.core.job.progress_text import ProgressPrinter, describe
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.splats.formats import read_splats
from gskin_addon.core.splats.ply import write_ply

PROGRAM = Path(gskin_addon.__file__).with_name("cli.py")


@pytest.fixture
def rod(tmp_path):
    path = tmp_path / "rod.ply"
    write_ply(path, jobs.rod(300)[0])
    return path


def one_sentence(text: str) -> bool:
    return text.count("\n") == 1 and text.rstrip().endswith((".", "--help."))


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["rig"],
        ["rig", "a.ply", "--armature", "r.glb"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--preset", "hasty"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--guidance", "magic"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--max-influences", "-1"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--seed", "-1"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--max-aspect", "0.5"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--field", "grid"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--rasterizer", "ray"],
        ["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", "--arm", "x"],
        ["train-guidance"],
        ["train-guidance", "pairs", "assets"],
        ["train-guidance", "pairs", "assets", "--out", "o", "--size", "500"],
        ["train-guidance", "pairs", "assets", "--out", "o", "--validation", "2"],
        ["render", "a.ply", "--out", "o.png", "--background", "1", "2", "0"],
        ["render", "a.ply", "--out", "o.png", "--size", "many"],
    ],
)
def test_wrong_options_are_one_sentence_and_exit_2(arguments, capsys):
    assert cli.main(arguments) == 2
    assert one_sentence(capsys.readouterr().err)


def test_help_and_version_exit_0(capsys):
    assert cli.main(["--help"]) == 0
    assert cli.main(["rig", "--help"]) == 0
    assert cli.main(["--version"]) == 0
    assert "Exit codes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"splats": "none.ply"}, "does not exist"),
        ({"splats": "rod.lcc"}, "splat-transform"),
        ({"splats": "rod.splat"}, "32"),
        ({"out": "out.fbx"}, ".blend or .glb"),
        ({"out": "nowhere/out.blend"}, "make"),
        ({"weights": "w.txt"}, ".npz"),
        ({"python": "no/such/python"}, "does not exist"),
        ({"splats": "mesh.ply"}, "mesh.ply"),
        ({"splats": "cut.ply"}, "cut off"),
        ({"splats": "hole.ply"}, "hole.ply"),
        ({"option": "novalue"}, "NAME=VALUE"),
    ],
)
def test_bad_input_exits_2_before_blender_is_needed(changed, word, rod, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("GSKIN_PYTHON", sys.executable)
    monkeypatch.setattr(rig, "require_bpy", lambda: pytest.fail("bad input must be seen first"))
    mesh = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "mesh.ply").write_text(mesh + "element face 0\nproperty list uchar int i\nend_header\n0 0 0\n")
    (tmp_path / "rod.lcc").write_bytes(b"a capture")
    (tmp_path / "rod.splat").write_bytes(b"no splats")
    (tmp_path / "cut.ply").write_bytes(rod.read_bytes()[:-100])
    cloud = jobs.rod(300)[0]
    cloud.means[7, 1] = np.nan
    write_ply(tmp_path / "hole.ply", cloud)
    if "python" in changed:
        monkeypatch.delenv("GSKIN_PYTHON")
    if "option" in changed:
        monkeypatch.setattr(rig, "require_bpy", lambda: rig.parse_options([changed["option"]]))
    arguments = ["rig", str(tmp_path / changed.get("splats", "rod.ply")), "--armature", "rig.blend"]
    arguments += ["--out", str(tmp_path / changed.get("out", "out.blend"))]
    arguments += ["--weights", str(tmp_path / changed.get("weights", "w.npz"))]
    if "python" in changed:
        arguments += ["--python", changed["python"]]
    assert cli.main(arguments) == 2
    text = capsys.readouterr().err
    assert one_sentence(text)
    assert word in text


@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (KeyboardInterrupt(), 130, "Cancelled"),
        (Cancelled("x"), 130, "Cancelled"),
        (Stopped("Stopped; 'x' stays."), 130, "Stopped; 'x' stays."),
        (InputError("the file 'x' is odd; mend it."), 2, "The file 'x' is odd; mend it."),
        (GSkinError("It broke."), 1, "It broke."),
        (OSError(errno.ENOSPC, "No space left on device", "w.npz"), 1, "disk is full"),
        (ZeroDivisionError("by nought"), 1, "ZeroDivisionError"),
    ],
)
def test_what_goes_wrong_becomes_a_code_and_a_sentence(error, code, word, monkeypatch, capsys):
    def fail(options):
        raise error

    monkeypatch.setattr(render, "run", fail)
    before = signal.getsignal(signal.SIGINT)
    assert cli.main(["render", "a.ply", "--out", "o.png"]) == code
    text = capsys.readouterr().err
    assert one_sentence(text)
    assert word in text
    assert signal.getsignal(signal.SIGINT) is before


def test_verbose_tells_where(monkeypatch, capsys):
    monkeypatch.setattr(render, "run", lambda options: 1 / 0)
    assert cli.main(["render", "a.ply", "--out", "o.png", "--verbose"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_convert_turns_axes_where_formats_say_them(tmp_path, capsys):
    """As splat-transform does: what has no rule has -y up."""
    cloud = random_cloud(30, 1)
    write_ply(tmp_path / "a.ply", cloud)
    assert cli.main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.glb")]) == 0
    assert "30 splats" in capsys.readouterr().err
    turned = read_splats(tmp_path / "b.glb").cloud
    np.testing.assert_allclose(turned.means, cloud.means * [1, -1, -1], atol=1e-6)
    assert cli.main(["convert", str(tmp_path / "b.glb"), str(tmp_path / "c.ply")]) == 0
    np.testing.assert_allclose(read_splats(tmp_path / "c.ply").cloud.sh, cloud.sh, atol=1e-5)
    arguments = ["convert", str(tmp_path / "a.ply"), str(tmp_path / "d.splat")]
    assert cli.main(arguments) == 0
    np.testing.assert_array_equal(read_splats(tmp_path / "d.splat").cloud.means, cloud.means)
    assert cli.main([*arguments, "--up", "z"]) == 0
    np.testing.assert_allclose(read_splats(tmp_path / "d.splat").cloud.means, cloud.means[:, [0, 2, 1]] * [1, -1, 1])
    assert cli.main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.ply")]) == 2
    assert cli.main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.usd")]) == 2
    assert not (tmp_path / "a.usd").exists()


def test_convert_says_what_turns_and_what_stays_behind(tmp_path, capsys):
    source = tmp_path / "a.ply"
    write_ply(source, dataclasses.replace(random_cloud(30, 1), offset=np.array([5.4e6, 0.0, -300.0])))
    source.write_bytes(source.read_bytes().replace(b"element", b"comment up_axis = z\nelement", 1))
    assert cli.main(["convert", str(source), str(tmp_path / "b.ply")]) == 0
    assert f"'{tmp_path / 'b.ply'}' is -Y up, '{source}' Z; --out-up=z keeps that." in capsys.readouterr().err
    assert cli.main(["convert", str(source), str(tmp_path / "c.ply"), "--out-up=z"]) == 0
    assert "keeps that" not in capsys.readouterr().err
    assert cli.main(["convert", str(source), str(tmp_path / "d.spz")]) == 0
    said = capsys.readouterr().err
    assert f"Warning: '{tmp_path / 'd.spz'}': its coordinates are near the origin: (5400000, -300, " in said


def test_render_draws_a_ply(rod, tmp_path):
    out = tmp_path / "rod.png"
    arguments = ["render", str(rod), "--out", str(out), "--size", "96", "--view", "front"]
    assert cli.main([*arguments, "--background", "0", "0", "1"]) == 0
    upright = np.asarray(Image.open(out)).astype(int)
    assert upright.shape == (96, 96, 3)
    assert upright[0, 0].tolist() == [0, 0, 255]
    drawn = (np.abs(upright - [0, 0, 255]).sum(axis=2) > 40).nonzero()
    assert np.ptp(drawn[0]) > 3 * np.ptp(drawn[1])
    assert cli.main([*arguments, "--ply-up", "y"]) == 0
    lying = np.asarray(Image.open(out)).astype(int)
    drawn = (np.abs(lying - [0, 0, 255]).sum(axis=2) > 40).nonzero()
    assert np.ptp(drawn[0]) < 1.5 * np.ptp(drawn[1])  # seen along its axis


@pytest.mark.parametrize("extra", [["--color", "weights"], ["--engine", "cycles"], ["--rotate", "a", "1", "2", "3"]])
def test_a_ply_has_no_rig(rod, tmp_path, extra, capsys):
    assert cli.main(["render", str(rod), "--out", str(tmp_path / "o.png"), *extra]) == 2
    assert one_sentence(capsys.readouterr().err)


def test_started_by_its_path_with_and_without_a_double_dash(rod, tmp_path):
    out = tmp_path / "o.png"
    for dash in ([], ["--"]):
        command = [sys.executable, str(PROGRAM), *dash, "render", str(rod), "--out", str(out), "--size", "32"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == ""
        out.unlink()


def test_parsing_of_turns_and_guidance_options():
    assert parse_turns([["arm", "1", "-2.5", "3e1"]]) == {"arm": (1.0, -2.5, 30.0)}
    with pytest.raises(InputError, match="arm"):
        parse_turns([["arm", "1", "much", "3"]])
    given = rig.parse_options(["weights=/a=b.npz", "steps=3", "soft=true"])
    assert given == {"weights": "/a=b.npz", "steps": 3, "soft": True}


def settings_of(*arguments):
    """The job that a command asks for, checked."""
    options = parser.build().parse_args(["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", *arguments])
    return JobSettings.parse(job_settings(options, {}))


def test_what_is_not_given_is_as_the_preset_says():
    plain, paper = settings_of(), settings_of("--preset", "paper")
    assert plain == JobSettings()
    assert (paper.init, paper.max_influences, paper.losses["arap_neighbours"]) == ("visibility", 0, 30)
    given = ["--preset", "paper", "--init", "heat", "--max-influences", "3", "--views", "6", "--loss", "anchor=0.5"]
    changed = settings_of(*given, "--field-option", "start=prior", "--field-option", "resolution=64")
    assert (changed.init, changed.max_influences, changed.views) == ("heat", 3, 6)
    assert changed.losses == {"anchor": 0.5, "arap_neighbours": 30, "arap_nodes": 0}
    assert changed.field_options == {"start": "prior", "resolution": 64}
    assert settings_of("--max-influences", "0").max_influences == 0
    assert settings_of("--field-option", "resolutions=[8,16]").field_options == {"resolutions": [8, 16]}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--loss", "arap"], "--loss 'arap' is not NAME=VALUE"),
        (["--loss", "rigid=1"], "no option rigid; they have arap, coupling"),
        (["--loss", "arap=much"], "loss option arap is 'much'; use a number"),
        (["--loss", "arap_neighbours=0"], "arap_neighbours is 0"),
        (["--loss", "arap=NaN"], "losses has a number that is too large or none"),
        (["--field-option", "=3"], "--field-option '=3' is not NAME=VALUE"),
        (["--field-option", "resolution=64"], "'pyramid' has no option resolution; it has resolutions"),
        (["--field", "volume", "--field-option", "resolution=65"], "resolution is 65; it must be a power of 2"),
    ],
)
def test_wrong_losses_and_field_options_are_one_sentence(arguments, words):
    with pytest.raises(InputError, match=words) as refused:
        settings_of(*arguments)
    assert one_sentence(str(refused.value) + "\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--preset", "paper"], "initial weights (visibility) are the result; for --preset paper to count"),
        (["--views", "2", "--loss", "arap=1"], "initial weights (learned) are the result; for --views, --loss to"),
        (["--field", "volume", "--field-option", "start=fit"], "for --field, --field-option to count"),
        (["--preset", "paper", "--guidance", "elastic"], ""),
        ([], ""),
        (["--max-influences", "2", "--init", "heat"], ""),
    ],
)
def test_options_of_learning_without_guidance_are_told(arguments, words):
    """The preset paper without a guidance would pass for the paper, and be its initial weights."""
    options = parser.build().parse_args(["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", *arguments])
    said = warning_of_no_guidance(options, JobSettings.parse(job_settings(options, {})))
    assert words in said
    assert bool(words) == bool(said)


def guidance_of(*arguments):
    return rig.guidance_options(
        parser.build().parse_args(["rig", "a.ply", "--armature", "r.glb", "--out", "o.blend", *arguments])
    )


def test_guidance_options_have_the_types_that_the_guidance_wants(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("7").mkdir()
    given = ["model=7", "steps=4", "strength=0.5", "prompt=true colours"]
    arguments = [word for pair in given for word in ("--guidance-option", pair)]
    wanted = {"model": str(tmp_path / "7"), "steps": 4, "strength": 0.5, "prompt": "true colours"}
    assert guidance_of("--guidance", "flux_repair", *arguments) == wanted
    # Consent is no option: it goes with the process, see tests/core/guidance/test_consent.py.
    agreed = ("--guidance", "flux_repair", "--guidance-option", "model=a/b", "--allow-download")
    assert guidance_of(*agreed) == {"model": "a/b"}
    assert guidance_of("--guidance", "oracle", "--guidance-option", "a=1") == {"a": 1}
    for arguments, words in (
        (("--guidance", "flux_repair", "--guidance-option", "steps=many"), "whole number"),
        (("--guidance", "flux_repair", "--guidance-option", "color=red"), "no option 'color'"),
        (("--guidance", "flux_repair"), "No FLUX.2 .* is named"),
        (("--guidance", "flux_repair", "--guidance-option", "model=8"), "'8', does not exist"),
        (("--guidance", "elastic", "--allow-download"), "fetches nothing"),
        (("--guidance", "elastic", "--guidance-option", "strength=0.5"), "'elastic' has no option 'strength', nor any"),
        (("--guidance-option", "models=a"), "'none' has no option 'models'.* lightning_drag"),
        (("--guidance", "flux_repair", "--guidance-option", "allow_download=true"), "agree when you start"),
    ):
        with pytest.raises(InputError, match=words):
            guidance_of(*arguments)


def test_progress_on_lines_bar_and_json():
    events = [ProgressEvent("initial", 0.01), ProgressEvent("initial", 0.02, 65.0), ProgressEvent("learn", 0.5, 9.0)]
    shown = {}
    for mode in ("auto", "bar", "json", "none"):
        stream = io.StringIO()
        printer = ProgressPrinter(mode, stream)
        for event in events:
            printer(event)
        printer.close()
        shown[mode] = stream.getvalue()
    assert shown["auto"].splitlines() == ["  1 %  initial", " 50 %  learn, 0:09 left"]
    assert shown["bar"].count("\r") == 3
    assert shown["bar"].endswith("\n")
    assert len(shown["json"].splitlines()) == 3
    assert '"seconds_left": 65.0' in shown["json"]
    assert shown["none"] == ""
    assert describe(events[1]) == "  2 %  initial, 1:05 left"


def test_bad_splats_are_left_out_and_counted(capfd):
    cloud = jobs.rod(300)[0]
    means, scales = cloud.means.copy(), cloud.scales.copy()
    means[7] += (5, 0, 0)
    scales[:, :] = (0.01, 0.02, 0.001)
    scales[9, 0] = 0.2
    bad = replace(cloud, means=means, scales=scales)
    assert rig.clean(bad, False, 0.0, False) is bad
    tidy = rig.clean(bad, True, 4.0, True)
    assert tidy.count == 299
    assert np.ptp(tidy.scales, axis=1).max() == 0
    said = capfd.readouterr()
    assert "1 strays and 0 faint giants of 300" in said.out + said.err
    assert "1 needles of 299" in said.out + said.err
