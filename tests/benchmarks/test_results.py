# SPDX-License-Identifier: GPL-3.0-or-later
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from benchmark_bodies import result

from benchmarks.quality import work
from benchmarks.quality.catalog import CATEGORIES, Entry, balanced
from benchmarks.quality.protocol import Protocol
from benchmarks.quality.report import BEGIN, END, page, write_section
from benchmarks.quality.results import FAILED, PARTLY, Store, load_weights, save_weights, weights_path
from benchmarks.quality.summary import Summary, acceptance
from benchmarks.quality.tables import failure_list, main_table, robust_table


def test_the_cache_outlives_a_kill_and_the_last_line_counts(tmp_path):
    store = Store(tmp_path)
    store.add(result("cow", "initial", 1.0))
    store.add(result("cow", "initial", 0.5))
    store.add(result("fox", "initial", 2.0))
    path = tmp_path / "results.jsonl"
    path.write_text(path.read_text()[:-40])  # killed within the last line
    again = Store(tmp_path)
    assert {r.asset: r.score["error"] for r in again} == {"cow": 0.5}
    assert again.get(("cow", "initial", "own", "p")).score["error"] == 0.5
    assert again.get(("fox", "initial", "own", "p")) is None
    again.add(result("fox", "initial", 3.0))
    assert {r.asset: r.score["error"] for r in Store(tmp_path)} == {"cow": 0.5, "fox": 3.0}


def test_a_protocol_is_known_by_its_values():
    assert Protocol().key == Protocol().key
    assert Protocol(frames=12).key != Protocol().key
    assert Protocol(unused_bones=True).key != Protocol().key


def test_weights_are_kept_for_pictures(tmp_path):
    weights = np.random.default_rng(0).dirichlet(np.ones(5), 40).astype(np.float32)
    path = weights_path(tmp_path, "cow", "ours:learned+none", "p")
    save_weights(path, weights)
    assert ":" not in path.name
    assert np.abs(load_weights(path) - weights).max() < 1e-3


def test_a_sample_is_balanced_and_always_the_same():
    entries = [Entry(f"a{i}", c, f"f{i % 3}") for i, c in enumerate(CATEGORIES * 9)]
    few, more = balanced(entries, 12), balanced(entries[::-1], 20)
    assert more[:12] == few
    assert set(Counter(e.category for e in few).values()) == {3}
    assert len({(e.category, e.family) for e in few}) == 12
    assert len(balanced(entries, 99)) == 36


def synthetic():
    """Four animals: ours halves the error on three and is worse on one; heat lies between, and fails once."""
    results = []
    errors = {"a": (1.0, 0.8, 0.5), "b": (2.0, 0.9, 1.0), "c": (0.4, 0.6, 0.2), "d": (0.2, 0.3, 0.4)}
    for asset, three in errors.items():
        methods = ("initial", "heat_mesh", "ours:default")
        results += [result(asset, method, error) for method, error in zip(methods, three, strict=True)]
    results[1] = replace(results[1], status=FAILED, note="no solution")
    results[4] = replace(results[4], status=PARTLY, note="3 of 9 vertices")
    return results


def test_numbers_of_synthetic_results():
    summary = Summary([*synthetic(), result("a", "initial", 9.0, protocol="another")], "p")
    assert summary.methods() == ["initial", "heat_mesh", "ours:default"]
    assert summary.mean("initial", "error") == pytest.approx(0.9)
    assert summary.ratio("ours:default") == pytest.approx((0.5 + 0.5 + 0.5 + 2) / 4)
    assert summary.worse_than_initial("ours:default") == 0.25
    assert summary.beats_mesh("ours:default") == 0.5
    lines = {line.name: str(line) for line in acceptance(summary)}
    assert lines["ratio to initial"] == "ratio to initial 0.875 <=0.350 MISS"
    assert lines["error against bone heat on the true mesh, all"].endswith("0.525 <=0.650 ok")
    assert lines["error against bone heat on the true mesh, animal"].endswith("ok")
    assert "error against bone heat on the true mesh, creature" not in lines
    assert lines["share better than bone heat"].endswith("0.500 >=0.650 MISS")
    assert lines["PSNR gain in dB"].endswith("0.375 >=4.000 MISS")
    row = next(line for line in main_table(summary).splitlines() if "`heat_mesh`" in line)
    assert [cell.strip() for cell in row.split("|")][-3:] == ["1", "1", ""]
    assert "`heat_mesh`, failed on 1" in failure_list(summary)
    assert "a: no solution" in failure_list(summary)
    assert acceptance(Summary([], "p")) == []
    assert summary.only(["a", "b"]).mean("initial", "error") == pytest.approx(1.5)
    few = Summary([r for r in synthetic() if (r.asset, r.method) != ("d", "ours:default")], "p")
    assert "On the 3 assets that all of these methods have" in page(few, Protocol(), "2-core CPU", [])


def test_robust_table_counts_common_assets_only():
    results = synthetic()
    for skeleton, factor in (("redundant", 1.0), ("moved", 2.0), ("missing", 1.5)):
        for asset in ("a", "b"):
            for method in ("initial", "ours:default"):
                own = next(r for r in results if (r.asset, r.method) == (asset, method))
                score = {**own.score, "error": own.score["error"] * factor}
                results.append(replace(own, skeleton=skeleton, score=score))
    text = robust_table(Summary(results, "p"), ("initial", "heat_mesh", "ours:default"))
    assert "on 2 assets" in text
    assert "| `ours:default` | 0.750 | 0.750 (x 1.00) | 1.500 (x 2.00) | 1.125 (x 1.50) |" in text
    assert "heat_mesh" not in text


def test_the_page_goes_between_its_markers(tmp_path):
    path = tmp_path / "benchmarks.md"
    path.write_text(f"# Before\n\n{BEGIN}\nold\n{END}\n\nAfter.\n")
    text = page(Summary(synthetic(), "p"), Protocol(), "2-core CPU", [("images/x.jpg", "best")])
    write_section(path, text)
    write_section(path, text)
    out = path.read_text()
    assert out.startswith("# Before\n")
    assert out.endswith("After.\n")
    assert "old" not in out
    assert out.count("| `heat_mesh` | 4 |") == 1
    assert "ratio to initial 0.875 <=0.350 MISS" in out
    (tmp_path / "other.md").write_text("nothing")
    with pytest.raises(ValueError, match="lacks"):
        write_section(tmp_path / "other.md", text)


def _play(task, protocol, folder, lpips):
    """Stands for work.perform in the workers: of the methods some are fine, one hangs, one is slow, one crashes."""
    import os

    yield "start", "(loading)", 60.0
    if task.asset == "broken":
        os._exit(4)
    for method, why in task.failed:
        yield "result", result(task.asset, method, 9.0, status=FAILED, note=why)
    for method in task.methods:
        if method == "absent":
            yield "unavailable", method, "not here"
            continue
        yield "start", method, 0.1 if method == "hang" else 1.0
        if method == "hang":
            time.sleep(60)
        if method == "slow":
            work.limit_cpu(0.1)
            while True:
                pass
        if method == "crash":
            os._exit(3)
        yield "made", method
        yield "result", result(task.asset, method, 1.0)


def test_a_run_survives_crashes_and_the_clock(tmp_path, monkeypatch):
    from benchmarks.quality import runner

    monkeypatch.setattr(runner, "perform", _play)
    monkeypatch.setattr(runner, "_SPAWN", runner.multiprocessing.get_context("fork"))
    found, absent = [], []
    methods = {"cow": ("fine", "hang", "slow", "absent", "crash", "last"), "broken": ("fine",), "fox": ("fine",)}
    tasks = [work.Task(asset, "own", names) for asset, names in methods.items()]
    runner.run_tasks(tasks, Protocol(), tmp_path, report=found.append, missing=lambda m, why: absent.append((m, why)))
    status = {(r.asset, r.method): (r.status, r.note) for r in found}
    assert status == {
        ("cow", "fine"): ("ok", ""),
        ("cow", "hang"): (FAILED, "hung for 2 s"),
        ("cow", "slow"): (FAILED, "took longer than 1 core-seconds"),
        ("cow", "crash"): (FAILED, "its process ended (code 3)"),
        ("cow", "last"): ("ok", ""),
        ("fox", "fine"): ("ok", ""),
    }
    assert len(found) == 6
    assert absent == [
        ("absent", "not here"),
        ("fine", "broken cannot be judged, (loading) its process ended (code 4)"),
    ]
