# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel from import to export: what it checks, what each click mends, and what it draws."""

from __future__ import annotations

import json
import os
import struct
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import pretend
import worker_jobs as jobs

from gskin_addon.core.files import write_png
from gskin_addon.core.job.settings import JobSettings
from gskin_addon.core.rig.influences import Influences
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.scene import names, rig_fit
from gskin_addon.scene.anchored import proxy_of
from gskin_addon.scene.attributes import read_attribute, write_positions
from gskin_addon.scene.proxy_object import create_mesh_object
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import read_weights, write_weights
from gskin_addon.session import learning_runtime, live_pictures, preferences, readiness, running_job
from gskin_addon.session.chosen import chosen_splats
from gskin_addon.session.confidence import sure_share
from gskin_addon.session.readiness import checks, what_is_missing
from gskin_addon.ui import check_list, progress, splat_panels
from gskin_addon.ui.panel import GSKIN_PT_main


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Chosen splats, a rod of 2000, and an armature in them; a worker that only pretends."""
    with pretend.session(tmp_path, monkeypatch) as scene:
        readiness.forget()
        monkeypatch.setattr(progress, "wrap", lambda text, width: [text])  # without a window nothing has a size
        scene.gskin.splats = create_splat_object(jobs.rod(2000)[0], "Rod")
        scene.gskin.armature = pretend.add_armature()
        bpy.context.view_layer.update()
        yield scene


@pytest.fixture
def splats(scene):
    return scene.gskin.splats


@pytest.fixture
def armature(scene):
    return scene.gskin.armature


def bad() -> list[readiness.Check]:
    bpy.context.view_layer.update()
    return [check for check in checks(bpy.context) if check.state != "ok"]


def click(check: readiness.Check) -> set[str]:
    group, _, name = check.operator.partition(".")
    return getattr(getattr(bpy.ops, group), name)(**dict(check.options))


def bind(splats, armature, confidence=None, start=None) -> None:
    count = len(splats.data.vertices)
    high = np.clip(read_cloud(splats).means[:, 2] / 2, 0, 1)
    weights = np.stack([1 - high, high], axis=1).astype(np.float32)
    write_weights(splats, armature, weights, ["lower", "upper"], confidence=confidence, start=start)
    assert len(splats.data.vertices) == count


# --- checks and the clicks that mend


def test_all_is_well(scene):
    assert bad() == []
    assert what_is_missing(bpy.context) == ""
    assert {check.name for check in checks(bpy.context)} >= {"Splats", "Armature", "Scale", "Size", "Place", "Strays"}


@pytest.mark.parametrize("factor", [0.01, 0.2, 100])
def test_a_rig_of_another_size(scene, armature, factor):
    armature.scale = [factor] * 3
    (check,) = bad()
    assert check.name == "Size"
    assert f"times too {'small' if factor < 1 else 'large'}" in check.sentence
    assert check.operator == "gskin.fix_rig_scale"
    assert click(check) == {"FINISHED"}
    # Units are mended exactly; 0.2 is none, there the bones get the size of the splats.
    assert armature.scale[0] == (pytest.approx(0.9, rel=0.1) if factor == 0.2 else pytest.approx(1.0))
    assert bad() == []
    assert bpy.ops.gskin.auto_skin.poll()


def test_what_carries_the_rig_is_scaled(scene, armature):
    carrier = bpy.data.objects.new("Carrier", None)
    scene.collection.objects.link(carrier)
    armature.parent = carrier
    carrier.scale = (50, 50, 50)
    assert click(bad()[0]) == {"FINISHED"}
    assert tuple(armature.scale) == (1, 1, 1)
    assert bad() == []


def test_a_rig_in_another_unit_keeps_the_job_from_running(scene, armature):
    armature.scale = (100, 100, 100)  # its first bone still begins in the splats
    (check,) = bad()
    assert check.state == "stop"
    assert "times too large" in what_is_missing(bpy.context)


def test_a_rig_too_large_is_only_a_warning_where_it_overlaps(scene, armature):
    armature.scale = (3, 3, 3)
    armature.location.z = -2
    assert [(check.name, check.state) for check in bad()] == [("Size", "warn")]
    assert what_is_missing(bpy.context) == ""


def test_a_rig_elsewhere_is_moved_into_the_splats(scene, armature):
    armature.location = (7, 8, 9)
    (check,) = bad()
    assert (check.name, check.state, check.operator) == ("Place", "stop", "gskin.center_rig")
    assert "'Rig' does not overlap 'Rod'" in check.sentence
    assert what_is_missing(bpy.context) == check.sentence
    assert click(check) == {"FINISHED"}
    assert bad() == []
    np.testing.assert_allclose(armature.location, 0, atol=0.05)


def test_splats_that_were_placed_bring_their_rig_along(scene, splats, armature):
    splats.data.transform(splats.matrix_world.Translation((5, 0, 3)))
    armature.location = (5, 0, 3)
    bpy.ops.gskin.place_on_floor()
    (check,) = bad()
    assert check.operator == "gskin.move_rig_to_splats"
    assert click(check) == {"FINISHED"}
    assert bad() == []


def test_splats_that_lie_are_turned_up(scene, splats):
    cloud = read_cloud(splats)
    write_positions(splats.data, cloud.means[:, [0, 2, 1]] * (1, 1, -1))
    readiness.forget()
    (check,) = bad()
    assert (check.name, check.operator, check.options) == ("Place", "gskin.turn_up", (("up", "y"),))
    assert "--" not in check.sentence
    assert click(check) == {"FINISHED"}
    assert bad() == []


def test_bones_that_do_not_deform(scene, armature):
    for bone in armature.data.bones:
        bone.use_deform = False
    (check,) = bad()
    assert (check.state, check.operator) == ("stop", "gskin.enable_deform")
    assert click(check) == {"FINISHED"}
    assert bad() == []


def test_a_rig_without_bones_has_nothing_to_turn_on(scene):
    scene.gskin.armature = bpy.data.objects.new("Empty Rig", bpy.data.armatures.new("Empty Rig"))
    scene.collection.objects.link(scene.gskin.armature)
    assert bad()[0].operator == ""
    assert not bpy.ops.gskin.enable_deform.poll()


@pytest.mark.parametrize(
    ("which", "scale"), [("Rod", (1, 1, 1.5)), ("Rod", (1, -1, 1)), ("Rig", (1, 1, 1.5)), ("Rig", (1, -1, 1.5))]
)
def test_uneven_scale_is_made_even(scene, which, scale):
    bpy.data.objects[which].scale = scale
    (check,) = bad()
    assert f"'{which}' is " in check.sentence
    assert click(check) == {"FINISHED"}
    assert bad() == []
    assert len({round(value, 6) for value in bpy.data.objects[which].scale}) == 1
    assert not bpy.ops.gskin.even_scale.poll()


def test_a_mirrored_rig_is_fine(scene, splats, armature):
    armature.scale = (1, 1, -1)
    bpy.context.view_layer.update()
    assert bad() == []
    armature.data.bones[0].bbone_segments = 4
    (check,) = bad()
    assert "'Rig' is mirrored" in check.sentence
    assert click(check) == {"FINISHED"}
    assert bad() == []


def test_an_uneven_parent_is_named_and_left(scene, splats, armature):
    carrier = bpy.data.objects.new("Carrier", None)
    scene.collection.objects.link(carrier)
    carrier.scale, splats.parent = (1, 1, 2), carrier
    (check,) = bad()
    with pytest.raises(RuntimeError, match="follows 'Carrier'"):
        click(check)
    assert tuple(carrier.scale) == (1, 1, 2)


def test_edit_mode_is_left(scene, splats):
    bpy.context.view_layer.objects.active = splats
    bpy.ops.object.mode_set(mode="EDIT")
    (check,) = bad()
    assert (check.name, check.state) == ("Mode", "stop")
    assert click(check) == {"FINISHED"}
    assert bad() == []


def test_strays_are_a_warning_and_are_put_aside(scene, splats):
    points = read_cloud(splats).means.copy()
    points[:30] = np.random.default_rng(0).uniform(5, 9, (30, 3))
    write_positions(splats.data, points)
    (check,) = bad()
    assert (check.name, check.state, check.operator) == ("Strays", "warn", "gskin.clean_splats")
    assert what_is_missing(bpy.context) == ""
    assert click(check) == {"FINISHED"}
    assert len(splats.data.vertices) == 1970
    assert bad() == []


def test_a_broken_transform_is_a_warning(scene, splats):
    splats.data[names.MARK]["warning"] = "Turned after anchoring"
    assert [(check.state, check.sentence) for check in bad()] == [("warn", "Turned after anchoring")]


def test_guidance_without_a_runtime_is_installed_by_a_click(scene, monkeypatch, tmp_path):
    scene.gskin.guidance = "elastic"
    monkeypatch.setattr(preferences, "find_worker_python", lambda preference: None)
    monkeypatch.setattr(preferences, "runtime_folder", lambda context: tmp_path / "runtime")
    monkeypatch.setattr(learning_runtime, "runtime_folder", lambda context: tmp_path / "runtime")
    learning_runtime.forget()
    (check,) = bad()
    assert (check.name, check.state, check.operator) == ("Learning Runtime", "stop", "gskin.install_runtime")
    assert "GSKIN_PYTHON" not in check.sentence
    learning_runtime.forget()


def test_bound_splats_are_not_moved_by_a_click(scene, splats, armature):
    bind(splats, armature)
    splats.data.transform(splats.matrix_world.Translation((9, 0, 0)))
    check = next(check for check in bad() if check.name == "Place")
    assert check.operator == ""
    assert not bpy.ops.gskin.center_rig.poll()
    assert not bpy.ops.gskin.fix_rig_scale.poll()


def test_splats_are_not_read_on_every_redraw(scene, splats, monkeypatch):
    read = []
    original = readiness.sample_splats
    monkeypatch.setattr(readiness, "sample_splats", lambda obj: read.append(obj) or original(obj))
    for _ in range(5):
        checks(bpy.context)
    assert len(read) == 1
    scene.gskin.armature.location.x = 0.01  # the rig moves: the splats are where they were
    bad()
    assert len(read) == 1
    assert bpy.ops.gskin.check_again() == {"FINISHED"}
    assert len(read) == 2


def test_a_look_at_many_splats_is_quick(scene):
    many = create_splat_object(jobs.rod(150_000)[0], "Many", display=False)
    scene.gskin.splats = many
    assert len(rig_fit.sample_splats(many).points) <= rig_fit.SAMPLE
    checks(bpy.context)
    begun = time.process_time()
    for _ in range(10):
        checks(bpy.context)
    assert time.process_time() - begun < 30  # it does not read 150,000 splats ten times


# --- which splats a click is about


def test_a_posed_rig_keeps_its_splats(scene, splats, armature):
    bind(splats, armature)
    create_splat_object(jobs.rod(50)[0], "Another")
    scene.gskin.splats = scene.gskin.armature = None
    splats.select_set(False)
    armature.select_set(True)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="POSE")
    assert chosen_splats(bpy.context) == splats
    assert splat_panels.GSKIN_PT_weights.poll(bpy.context)
    bpy.ops.object.mode_set(mode="OBJECT")


def test_of_several_splats_on_a_rig_those_chosen_last_stay(scene, splats, armature):
    other = create_splat_object(jobs.rod(50)[0], "Another")
    for obj in (splats, other):
        bind(obj, armature)
        obj.select_set(False)
    scene.gskin.splats = None
    for obj in (splats, other, splats):
        bpy.context.view_layer.objects.active = obj
        assert chosen_splats(bpy.context) == obj
        bpy.context.view_layer.objects.active = armature
        assert chosen_splats(bpy.context) == obj


def test_a_rig_that_moves_no_splats_chooses_none(scene, armature):
    scene.gskin.splats = None
    bpy.context.view_layer.objects.active = armature
    assert chosen_splats(bpy.context) is None


# --- drawing


class Layout:
    """Writes down what is drawn: texts, properties, operators."""

    def __init__(self, drawn=None) -> None:
        self.drawn = [] if drawn is None else drawn

    def prop(self, owner, name, **look) -> None:
        assert name in owner.bl_rna.properties
        self.drawn.append(name)

    def prop_search(self, owner, name, *where, **look) -> None:
        self.drawn.append(name)

    def label(self, *, text, icon="NONE", **look) -> None:
        self.drawn.append(text)

    def operator(self, name, *, text=None, **look):
        group, _, word = name.partition(".")
        kind = getattr(getattr(bpy.ops, group), word).get_rna_type()
        assert kind.description, f"{name} has no tooltip"
        self.drawn.append(name if text is None else f"{name}: {text}")
        return SimpleNamespace()

    def operator_menu_enum(self, name, prop, **look) -> None:
        self.drawn.append(name)

    def progress(self, *, factor, text) -> None:
        assert 0 <= factor <= 1
        self.drawn.append(text)

    def template_icon(self, *, icon_value, scale) -> None:
        assert isinstance(icon_value, int)
        self.drawn.append("picture")

    def separator(self) -> None:
        pass

    def panel(self, name, **look):
        return Layout(self.drawn), Layout(self.drawn)

    def column(self, **look):
        return Layout(self.drawn)

    row = box = column


def drawn(panel=GSKIN_PT_main) -> list[str]:
    bpy.context.view_layer.update()
    itself = SimpleNamespace(layout=Layout())
    for name in ("_draw_chosen", "_draw_settings"):
        if hasattr(panel, name):
            setattr(itself, name, partial(getattr(panel, name), itself))
    panel.draw(itself, bpy.context)
    return itself.layout.drawn


def place(lines: list[str], start: str) -> int:
    return next(number for number, line in enumerate(lines) if line.startswith(start))


def test_the_panel_tells_the_story_in_order(scene):
    lines = drawn()
    story = ["gskin.import_splats", "splats", "armature", "Settings", "Ready", "gskin.auto_skin"]
    assert sorted(story, key=partial(place, lines)) == story
    assert "(about 3 s)" in lines[place(lines, "gskin.auto_skin")]


def test_the_time_follows_the_settings(scene):
    scene.gskin.guidance = "elastic"
    scene.gskin.preset = "paper"
    scene.gskin.splats = create_splat_object(jobs.rod(20_000)[0], "Many", display=False)
    assert "min)" in drawn()[place(drawn(), "gskin.auto_skin")]
    scene.gskin.guidance = "flux_repair"
    assert drawn()[place(drawn(), "gskin.auto_skin")] == "gskin.auto_skin: Auto-Skin Gaussians"


def test_problems_are_drawn_with_their_clicks(scene, armature):
    armature.scale = (100, 100, 100)
    lines = drawn()
    assert "1 thing to mend" in lines
    assert any(line.startswith("gskin.fix_rig_scale: Scale the Rig by 0.01") for line in lines)
    scene.gskin.splats = None
    assert "gskin.import_splats: Import Splats..." in drawn()


def test_the_buttons_options_are_the_checks(scene, monkeypatch):
    made = SimpleNamespace()
    check = readiness.Check("Place", "stop", "Lies down", "gskin.turn_up", "Turn Y Up", (("up", "y"),))
    layout = Layout()
    monkeypatch.setattr(Layout, "operator", lambda self, name, **look: made)
    check_list._draw_check(layout, check, 300)
    assert made.up == "y"


def running(folder) -> SimpleNamespace:
    """A job half done in `folder`."""
    return SimpleNamespace(
        progress=SimpleNamespace(fraction=0.5, message="Weights", stage="initial", losses={"l1": 0.1}),
        seconds_left=3.0, cancelling=False, cancel=lambda: None, pictures=folder,
    )  # fmt: skip


def test_a_running_job_hides_checks_and_button(scene, tmp_path):
    bpy.context.scene.gskin.splats = bpy.data.objects["Rod"]
    running_job.begin(running(tmp_path))
    lines = drawn()
    assert "50%  0:03 left" in lines
    assert "gskin.cancel_auto_skin" in lines
    assert not any(line.startswith(("gskin.auto_skin", "Ready")) for line in lines)


def test_a_running_job_shows_its_newest_pictures(scene, tmp_path):
    running_job.begin(running(tmp_path))
    assert not [line for line in drawn() if line.startswith("picture")]
    (tmp_path / "previews").mkdir()
    write_png(tmp_path / "previews" / "guidance.png", np.zeros((8, 8, 3)))
    first = live_pictures.icons(tmp_path)
    assert [name for name, _ in first] == ["Guidance"]
    # Pixels given by hand, and so read by no job of Blender's, each of which would draw all 3D views again.
    first_shown = live_pictures._loaded["guidance"]
    assert first_shown.is_image_custom
    assert live_pictures.icons(tmp_path) == first, "read again only when it is another"
    write_png(tmp_path / "previews" / "weights.png", np.ones((8, 8, 3)))
    lines = drawn()
    assert lines[place(lines, "picture") :][:4] == ["picture", "Guidance", "picture", "Weights"]
    stamp = (tmp_path / "previews" / "guidance.png").stat().st_mtime_ns
    write_png(tmp_path / "previews" / "guidance.png", np.full((6, 4, 3), 0.5))
    os.utime(tmp_path / "previews" / "guidance.png", ns=(stamp, stamp + 1000))
    live_pictures.icons(tmp_path)
    shown = live_pictures._loaded["guidance"]
    assert tuple(shown.image_size) == (4, 6), "a picture of the same second is another one"
    assert np.allclose(np.array(shown.image_pixels_float).reshape(6, 4, 4)[..., :3], 0.5, atol=0.01)
    high = np.zeros((600, 30, 3))
    high[300:] = (1.0, 0.5, 0.0)  # the lower half, which Blender has first
    write_png(tmp_path / "previews" / "guidance.png", high)
    live_pictures.icons(tmp_path)
    shown = live_pictures._loaded["guidance"]
    assert tuple(shown.image_size) == (10, 200)
    pixels = np.array(shown.image_pixels_float).reshape(200, 10, 4)
    assert np.allclose(pixels[0, 0], (1.0, 0.5, 0.0, 1.0), atol=0.01)
    assert np.allclose(pixels[-1, -1], (0.0, 0.0, 0.0, 1.0))
    running_job.end("done")
    assert live_pictures._loaded is None
    assert not [line for line in drawn() if line.startswith("picture")]


def test_confidence_is_a_bar(scene, splats, armature):
    assert sure_share(splats) is None
    bind(splats, armature, confidence=np.where(np.arange(2000) < 1500, 0.9, 0.1).astype(np.float32))
    assert sure_share(splats) == 0.75
    assert "75% of the splats are sure" in drawn()
    bind(splats, armature, confidence=np.ones(2000, np.float32))
    assert sure_share(splats) == 1.0


def test_where_all_are_sure_the_panel_tells_the_least_sure_apart(scene, splats, armature):
    sure = np.linspace(0.6, 1.0, 2000, dtype=np.float32)
    start = "bone heat", Influences.strongest(np.full((2000, 2), 0.5, np.float32))
    bind(splats, armature, confidence=sure, start=start)
    lines = drawn()
    assert not any("are sure" in line for line in lines)
    assert {"Least sure 1%: below 60%", "Least sure 5%: below 62%", "Least sure 10%: below 64%"} <= set(lines)
    assert "Half of them: above 80%" in lines
    bpy.ops.gskin.compare_weights(show="BEFORE")  # these numbers are not about the weights that are shown now
    assert not any("Least sure" in line for line in drawn())


def test_the_two_sides_of_the_weights_are_a_toggle(scene, splats, armature):
    assert "gskin.compare_weights: Bone heat" not in drawn()
    bind(splats, armature, start=("bone heat", Influences.strongest(np.full((2000, 2), 0.5, np.float32))))
    lines = drawn()
    row = place(lines, "gskin.compare_weights: Bone heat")
    assert lines[row : row + 2] == ["gskin.compare_weights: Bone heat", "gskin.compare_weights: Learned"]


def test_a_click_leads_to_the_rig(scene, splats, armature):
    assert "gskin.pose_rig" not in drawn()
    with pytest.raises(RuntimeError, match="follow an armature"):
        bpy.ops.gskin.pose_rig()
    bind(splats, armature)
    bpy.context.view_layer.objects.active = splats
    splats.select_set(True)
    assert "gskin.pose_rig" in drawn()
    assert bpy.ops.gskin.pose_rig() == {"FINISHED"}
    assert (bpy.context.mode, bpy.context.active_object) == ("POSE", armature)
    assert armature.show_in_front
    assert not splats.select_get()
    assert "gskin.pose_rig" not in drawn()
    with pytest.raises(RuntimeError, match="Pose Mode already"):
        bpy.ops.gskin.pose_rig()
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.hide_set(True)
    with pytest.raises(RuntimeError, match="'Rig' is hidden"):
        bpy.ops.gskin.pose_rig()


def test_the_weights_panel_has_a_click_for_each_way(scene, splats, armature):
    lines = drawn(splat_panels.GSKIN_PT_weights)
    assert {"gskin.load_weights: Load...", "gskin.save_weights: Save...", "gskin.anchor_to_mesh"} <= set(lines)
    verts = np.array([(x, y, z) for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (0, 2)], float)
    faces = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)]
    scene.gskin.proxy = create_mesh_object("Box", verts, faces)
    assert bpy.ops.gskin.anchor_to_mesh() == {"FINISHED"}
    assert proxy_of(splats) == scene.gskin.proxy
    assert "gskin.release_from_mesh" in drawn(splat_panels.GSKIN_PT_weights)


@pytest.mark.parametrize(
    ("operator", "words"),
    [
        ("undo_placement", "where their file has them"),
        ("move_rig_to_splats", "where their file has them"),
        ("even_scale", "have an even scale"),
        ("save_weights", "follow an armature"),
        ("export_glb", "follow no armature"),
        ("anchor_to_mesh", "name it as Proxy Mesh"),
        ("release_from_mesh", "follow a mesh"),
        ("select_unsure_splats", "how sure they are"),
    ],
)
def test_what_cannot_work_now_says_why(scene, operator, words):
    click = getattr(bpy.ops.gskin, operator)
    assert not click.poll()
    with pytest.raises(RuntimeError, match=words):
        click()


@pytest.mark.parametrize("operator", ["load_weights", "bind_to_armature", "save_weights"])
def test_weights_wait_for_the_end_of_edit_mode(scene, splats, armature, operator):
    bind(splats, armature)
    bpy.context.view_layer.objects.active = splats
    bpy.ops.object.mode_set(mode="EDIT")
    click = getattr(bpy.ops.gskin, operator)
    assert not click.poll()
    with pytest.raises(RuntimeError, match="Leave Edit Mode"):
        click()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert click.poll()


def test_placing_in_another_mode_says_why(scene, armature):
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="POSE")
    with pytest.raises(RuntimeError, match="Go to Object Mode"):
        bpy.ops.gskin.place_on_floor()
    bpy.ops.object.mode_set(mode="OBJECT")


def test_every_click_can_be_undone(scene):
    for name in ("fix_rig_scale", "center_rig", "enable_deform", "even_scale"):
        assert "UNDO" in getattr(bpy.types, f"GSKIN_OT_{name}").bl_options


# --- save and export


def test_settings_are_kept_as_a_preset(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("BLENDER_USER_SCRIPTS", str(tmp_path))
    scene.gskin.guidance, scene.gskin.preset, scene.gskin.max_influences = "elastic", "high", 3
    assert bpy.ops.gskin.job_preset_add(name="Mine") == {"FINISHED"}
    (kept,) = (tmp_path / "presets" / "gskin" / "job").glob("*.py")
    scene.gskin.guidance, scene.gskin.preset, scene.gskin.max_influences = "none", "draft", 4
    menu = "GSKIN_PT_job_presets"
    assert bpy.ops.script.execute_preset(filepath=str(kept), menu_idname=menu) == {"FINISHED"}
    assert (scene.gskin.guidance, scene.gskin.preset, scene.gskin.max_influences) == ("elastic", "high", 3)
    assert bpy.types.GSKIN_PT_job_presets.preset_subdir == bpy.types.GSKIN_OT_job_preset_add.preset_subdir


def test_a_preset_shows_what_it_brings_and_takes_it_back(scene):
    chosen = scene.gskin
    chosen.preset = "paper"
    assert (chosen.init, chosen.max_influences) == ("visibility", 0)
    assert JobSettings.parse(chosen.as_job()) == JobSettings.parse({"preset": "paper"})
    chosen.preset = "high"
    assert (chosen.init, chosen.max_influences) == ("learned", 4)
    # What a person chose stays.
    chosen.init, chosen.max_influences = "geodesic", 2
    chosen.preset = "paper"
    chosen.init = "heat"
    assert JobSettings.parse(chosen.as_job()).init == "heat"
    chosen.preset = "standard"
    assert (chosen.init, chosen.max_influences) == ("heat", 2)


def test_saved_weights_are_loaded_again(scene, splats, armature, tmp_path):
    assert not bpy.ops.gskin.save_weights.poll()
    bind(splats, armature, confidence=np.linspace(0, 1, 2000, dtype=np.float32))
    path = tmp_path / "rod.npz"
    assert bpy.ops.gskin.save_weights(filepath=str(path)) == {"FINISHED"}
    before, bones = read_weights(splats)
    saved = read_weights_file(path)
    assert list(saved.bones) == bones
    np.testing.assert_allclose(saved.weights, before / before.sum(axis=1, keepdims=True), atol=1e-6)
    scene.gskin.splats = other = create_splat_object(jobs.rod(2000)[0], "Other")
    assert bpy.ops.gskin.load_weights(filepath=str(path)) == {"FINISHED"}
    np.testing.assert_allclose(read_weights(other)[0], before, atol=1e-5)
    np.testing.assert_allclose(read_attribute(other.data, names.CONFIDENCE), np.linspace(0, 1, 2000), atol=1e-6)


def test_splats_without_weights_are_counted_and_not_saved(scene, splats, armature, tmp_path):
    bind(splats, armature)
    for group in splats.vertex_groups:
        group.remove([0, 1, 2])
    with pytest.raises(RuntimeError, match="3 of the 2,000 splats of 'Rod' have no weights"):
        bpy.ops.gskin.save_weights(filepath=str(tmp_path / "rod.npz"))
    assert not (tmp_path / "rod.npz").exists()


def test_export_of_a_rigged_figure(scene, splats, armature, tmp_path):
    assert not bpy.ops.gskin.export_glb.poll()
    bind(splats, armature)
    path = tmp_path / "rod.glb"
    assert bpy.ops.gskin.export_glb(filepath=str(path)) == {"FINISHED"}
    data = path.read_bytes()
    tree = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    assert "KHR_gaussian_splatting" in tree["extensionsUsed"]
    assert len(tree["skins"]) == 1
    with pytest.raises(RuntimeError, match=r"does not end in \.glb"):
        bpy.ops.gskin.export_glb(filepath=str(tmp_path / "rod.gltf"))
