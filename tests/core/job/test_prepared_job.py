# SPDX-License-Identifier: GPL-3.0-or-later
"""A job is checked and named once, before anything is written."""

from __future__ import annotations

import json

import numpy as np
import pytest
import worker_jobs as jobs
from proxy_meshes import tube

from gskin_addon.core.errors import InputError
from gskin_addon.core.job import contract
from gskin_addon.core.job.mesh_files import mesh_file, mesh_name, read_mesh, write_mesh


def test_a_prepared_job_is_the_one_that_write_job_writes(tmp_path):
    cloud, skeleton = jobs.rod()
    settings = {"preset": "draft", "seed": 3}
    prepared = contract.prepare_job(cloud, skeleton, settings)
    assert prepared.fingerprint == contract.fingerprint(cloud, skeleton, settings)
    one = prepared.write(tmp_path / prepared.fingerprint)
    other = contract.write_job(tmp_path / "other", cloud, skeleton, settings)
    assert {p.name for p in one.iterdir()} == {p.name for p in other.iterdir()}
    for path in one.iterdir():
        assert path.read_bytes() == (other / path.name).read_bytes(), path.name


def test_inputs_are_checked_and_hashed_once(tmp_path, monkeypatch):
    calls = []
    for name in ("check_inputs", "fingerprint"):
        real = getattr(contract, name)
        monkeypatch.setattr(contract, name, lambda *a, real=real, name=name, **k: calls.append(name) or real(*a, **k))
    job = contract.prepare_job(*jobs.rod(), {})
    job.write(tmp_path / job.fingerprint)
    assert calls == ["check_inputs", "fingerprint"]


def test_files_of_the_job_come_before_job_json(tmp_path, monkeypatch):
    verts, faces = tube(rings=5, sides=6)
    name, arrays = mesh_file(verts, faces)
    assert name == mesh_name(verts, faces) == write_mesh(tmp_path / "other", verts, faces)
    written = []
    for writer in ("write_arrays", "write_text", "write_json"):
        real = getattr(contract, writer)
        monkeypatch.setattr(
            contract, writer, lambda path, value, real=real: written.append(path.name) or real(path, value)
        )
    folder = contract.prepare_job(*jobs.rod(), {"mesh": name}, files={name: arrays}).write(tmp_path / "job")
    assert written[0] == name
    assert written[-1] == "job.json"
    np.testing.assert_array_equal(read_mesh(folder / name)[0], verts)
    assert (folder / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


@pytest.mark.parametrize("name", ["../a.npz", "/a.npz", "a/b.npz", "job.json", "splats.npz", "checkpoint", ""])
def test_files_of_a_job_stay_in_its_folder(name):
    with pytest.raises(ValueError, match="is no name"):
        contract.prepare_job(*jobs.rod(), {}, files={name: {"a": np.zeros(3)}})


def test_nothing_is_written_for_input_that_cannot_be_used(tmp_path):
    cloud, skeleton = jobs.rod()
    with pytest.raises(InputError, match="does not overlap"):
        contract.write_job(tmp_path / "job", cloud, skeleton.moved(np.eye(3), 1.0, (50, 0, 0)), {})
    with pytest.raises(InputError, match="settings"):
        contract.write_job(tmp_path / "job", cloud, skeleton, {"x": "\ud800"})
    assert not (tmp_path / "job").exists()


def test_a_damaged_job_json_is_another_job(tmp_path):
    folder = jobs.make_job(tmp_path)
    (folder / "checkpoint").mkdir()
    for text in ("[" * 100_000, "[]", '{"fingerprint": []}', "half"):
        (folder / "job.json").write_text(text)
        jobs.make_job(folder)
        assert json.loads((folder / "job.json").read_text())["version"] == 1
