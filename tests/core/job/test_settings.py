# SPDX-License-Identifier: GPL-3.0-or-later
"""Whatever stands in a job.json, it is a job or one sentence that names what is wrong."""

from __future__ import annotations

import inspect
import json
from importlib import import_module

import pytest
import worker_jobs as jobs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gskin_addon.core.errors import InputError
from gskin_addon.core.job import contract
from gskin_addon.core.job.settings import CHECKS, JobSettings
from gskin_addon.core.skinning import fields
from gskin_addon.core.skinning.losses import LossWeights
from gskin_addon.core.skinning.presets import PRESETS

JSON = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.sampled_from([10**400, -1, 0, 2**63, 1e300, -0.0]),
        st.floats(allow_nan=False, allow_infinity=False),
        st.text(max_size=10),
        st.sampled_from(["draft", "pyramid", "volume", "preset", "learned", "flux_repair", "..", "a" * 5000]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
    max_leaves=8,
)
WHOLE = {
    "preset": "draft",
    "guidance": "flux_repair",
    "init": "learned",
    "max_influences": 4,
    "seed": 7,
    "front": "-y",
    "views": 2,
    "options": {"model": "a/b", "strength": 0.5, "steps": 4, "offload": "none"},
    "init_options": {"model": ""},
    "field": "volume",
    "field_options": {"resolution": 16, "width": 8, "start": "fit", "fit_steps": 3},
    "mesh": "mesh-0123456789abcdef.npz",
    "edges_only": True,
    "hygiene": {"ignore_strays": False, "max_aspect": 4.5},
    "losses": {"arap": 0.5, "dssim": 0.1, "arap_nodes": 3},
    "scope": "scope-0123456789abcdef.npz",
    "rasterizer": "cpu",
}
TABLES = [name for name, value in WHOLE.items() if isinstance(value, dict)]


def refusal(values):
    """The sentence that refuses the settings, on one line, or None for a job."""
    try:
        JobSettings.parse(values)
    except InputError as error:
        told = str(error)
        return told if told.isprintable() else pytest.fail(f"not one line: {told!r}")
    return None


def test_the_whole_table_is_a_job_and_every_setting_is_checked():
    assert JobSettings.parse(WHOLE).as_dict() == WHOLE
    assert JobSettings.parse({}) == JobSettings()
    assert list(CHECKS) == list(JobSettings().as_dict())


# One wrong value of these makes the options of the other wrong.
PARTNERS = {"guidance": "options", "init": "init_options", "field": "field_options", "preset": "field_options"}


@given(name=st.sampled_from(sorted(WHOLE)), value=JSON)
@settings(max_examples=600, deadline=None)
def test_one_wrong_value_is_named(name, value):
    told = refusal({**WHOLE, name: value})
    assert told is None or name in told or PARTNERS.get(name, name) in told


@given(table=st.sampled_from(TABLES), value=JSON, data=st.data())
@settings(max_examples=600, deadline=None)
def test_one_wrong_value_in_a_table_is_named(table, value, data):
    key = data.draw(st.one_of(st.sampled_from(sorted(WHOLE[table])), st.text(min_size=1, max_size=6)))
    told = refusal({**WHOLE, table: {**WHOLE[table], key: value}})
    assert told is None or table in told


@given(values=st.dictionaries(st.one_of(st.sampled_from(sorted(WHOLE)), st.text(max_size=5)), JSON, max_size=6))
@settings(max_examples=600, deadline=None)
def test_any_table_is_a_job_or_a_sentence(values):
    if refusal(values) is None:
        found = JobSettings.parse(values)
        assert JobSettings.parse(found.as_dict()) == found


ALMOST = st.fixed_dictionaries(
    {"version": st.one_of(st.just(1), JSON)},
    optional={"settings": st.one_of(JSON, st.dictionaries(st.text(max_size=5), JSON)), "fingerprint": JSON},
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return jobs.make_job(tmp_path_factory.mktemp("job"))


@given(document=st.one_of(JSON, ALMOST))
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_json_as_job_json_is_a_job_or_a_sentence_that_names_the_file(folder, document):
    (folder / "job.json").write_text(json.dumps(document))
    sound = isinstance(document, dict) and type(document.get("version")) is int and document["version"] == 1
    if not sound or not isinstance(document.get("settings", {}), dict):
        with pytest.raises(InputError, match=r"job\.json"):
            contract.read_job(folder)
        return
    job = contract.read_job(folder)
    assert job.settings == document.get("settings", {})


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 5_000, "NaN", '{"version": NaN}', '{"version": Infinity}', "9" * 5_000, "\ufeff{}"],
)
def test_text_that_is_hardly_json(folder, text):
    (folder / "job.json").write_text(text)
    with pytest.raises(InputError, match=r"job\.json"):
        contract.read_job(folder)


@pytest.mark.parametrize("version", [True, 1.0, "1", None, [[1]]])
def test_the_version_is_a_number(folder, version):
    (folder / "job.json").write_text(json.dumps({"version": version, "settings": {}}))
    with pytest.raises(InputError, match="version"):
        contract.read_job(folder)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"preset": []}, r"preset is \[\]; choose one of draft"),
        ({"preset": {}}, r"preset is \{\}"),
        ({"hygiene": 3}, "hygiene are 3; they must be a table"),
        ({"losses": [1]}, r"losses are \[1\]; they must be a table"),
        ({"options": None}, "options are None; they must be a table"),
        ({"field_options": {"size": 3}}, "'pyramid' has no option size; it has resolutions"),
        ({"field": "volume", "field_options": {"resolutions": [8]}}, "'volume' has no option resolutions"),
        ({"init_options": {"model": "a" * 5000}}, "does not exist"),
        ({"init_options": {"model": "a\0b"}}, "does not exist"),
        ({"seed": 2**70}, "seed has a number that is too large"),
        ({"losses": {"arap": 10**400}}, "losses has a number that is too large"),
        ({"hygiene": {"max_aspect": float("inf")}}, "hygiene has a number"),
        ({"guidance": "oracle", "options": {"a": [[[[[[[[[[1]]]]]]]]]]}}, "options has lists or tables nested"),
        ({"nonsense": 1, 3: 2}, "unknown settings 3, nonsense"),
        ({"guidance": "flux_repair", "options": {"allow_download": True}}, "agree when you start"),
    ],
)
def test_what_used_to_slip_through(values, words):
    with pytest.raises(InputError, match=words):
        JobSettings.parse(values)


def test_a_preset_brings_settings_that_the_job_may_change():
    paper = JobSettings.parse({"preset": "paper", "guidance": "elastic"})
    assert (paper.init, paper.max_influences, paper.views) == ("visibility", 0, 4)
    assert paper.field_options == {"start": "fit"}
    assert paper.losses == {"anchor": 0.0, "arap_neighbours": 30, "arap_nodes": 0}
    own = {"init": "learned", "losses": {"arap": 0.5, "anchor": 0.01}, "field_options": {"fit_steps": 7}}
    changed = JobSettings.parse({"preset": "paper", **own})
    assert changed.init == "learned"
    assert changed.losses == {"anchor": 0.01, "arap_neighbours": 30, "arap_nodes": 0, "arap": 0.5}
    assert changed.field_options == {"start": "fit", "fit_steps": 7}
    assert JobSettings.parse({"preset": "paper", "field": "pyramid"}).field_options == {}
    assert JobSettings.parse({"preset": "thorough"}).init == "learned"


def test_the_preset_paper_is_the_schedule_of_the_paper():
    """Sec. III-D and IV: 200 images of four views, batches of 20, 500 iterations, 512 px, K_1 = 30, a 128^3 volume."""
    preset, chosen = PRESETS["paper"], JobSettings.parse({"preset": "paper"})
    assert (preset.poses_per_view * chosen.views, preset.batch, preset.stages) == (200, 20, ((512, 500),))
    assert (preset.held_out, preset.patience, preset.prune) == (0, 0, False)
    losses = LossWeights.parse(chosen.losses)
    assert (losses.anchor, losses.arap_neighbours, losses.arap_nodes) == (0, 30, 0)
    assert chosen.field_name(preset) == "volume"
    volume = import_module("gskin_addon.core.skinning.fields.volume")
    assert inspect.signature(volume.create).parameters["resolution"].default == 128
    assert volume.decoder_widths(128) == [512, 512, 256, 256, 128, 128]


@pytest.mark.parametrize("views", [0, 3, 5, 7, True, 2.0, "4", None, [4]])
def test_views_are_those_of_the_papers_ablation(views):
    with pytest.raises(InputError, match=r"views is .*choose one of 1, 2, 4, 6"):
        JobSettings.parse({"views": views})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"field": "volume", "field_options": {"resolution": 100}}, "resolution is 100; it must be a power of 2"),
        ({"field": "volume", "field_options": {"start": "zero"}}, "start is 'zero'; choose prior or fit"),
        ({"field": "volume", "field_options": {"width": True}}, "width is True"),
        ({"field_options": {"resolutions": [8, 10**9]}}, "resolutions are .*from 2 to 1024"),
        ({"preset": "paper", "field_options": {"resolutions": [8]}}, "'volume' has no option resolutions"),
    ],
)
def test_values_of_field_options_are_refused_before_any_work(values, words):
    with pytest.raises(InputError, match=words):
        JobSettings.parse(values)


@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../mesh.npz", "..", ".", "a/b.npz", "a\\b.npz", "C:a.npz", "a\0.npz", ".npz", "mesh.obj", "splats",
     3, None, [], "x" * 400 + ".npz"],
)  # fmt: skip
def test_a_job_speaks_of_no_file_outside_its_folder(name):
    for setting in ("mesh", "scope"):
        with pytest.raises(InputError, match=rf"{setting} is .* in the job's own folder"):
            JobSettings.parse({setting: name})


@pytest.mark.parametrize("name", sorted(fields.WEIGHT_FIELDS))
def test_the_options_of_the_weight_fields_are_those_that_they_take(name):
    create = import_module(f"gskin_addon.core.skinning.fields.{name}").create
    assert fields.OPTIONS[name] == tuple(inspect.signature(create).parameters)[2:]


@pytest.mark.parametrize("sizes", [3, "8", [], [1], [2.5], {"a": 8}, None])
def test_the_pyramids_sizes_are_checked(sizes):
    limb = jobs.rod(50)[0]
    with pytest.raises(InputError, match="resolutions are"):
        fields.create_field("pyramid", limb.means, [[1.0]] * 50, {"resolutions": sizes})
