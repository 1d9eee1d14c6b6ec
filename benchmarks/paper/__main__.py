# SPDX-License-Identifier: GPL-3.0-or-later
"""`make bench-paper`: the paper's tables in its protocol (Sec. IV-C), 24 frames x 6 views of each asset.

Runs what the cache lacks, prints the tables, and says what was not run; goes on where it was stopped. Table II with
vanilla and mesh-anchored splats, isotropic splats, the ablations, imperfect skeletons, and fine-tuning. Methods that do
not run here join by `--method-weights NAME=FOLDER` (docs/benchmark-protocol.md). Jobs cost minutes: use --sample.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from benchmarks.markers import write_between
from benchmarks.quality.export import chosen_entries
from benchmarks.quality.methods import from_file
from benchmarks.quality.protocol import Protocol
from benchmarks.quality.results import Result, Store
from benchmarks.quality.runner import run_tasks
from benchmarks.quality.work import Task, order_methods
from gskin_addon.core.errors import InputError

from .rows import Table, tables
from .text import read_facts, table_text, tuning_text

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Run, print, write; 2 when assets or options are wrong."""
    options = _parse()
    protocol = Protocol(
        splats=options.splats, frames=options.frames, picture_frames=options.frames, views=options.views,
        size=options.size,
    )  # fmt: skip
    try:
        given = from_file.register(options.method_weights)
        entries = chosen_entries(options.assets, options.sample)
        wanted = _chosen(tables(options.guidance, options.preset, given), options.tables)
        facts = read_facts(options.fine_tuned) if options.fine_tuned else None
    except (InputError, OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    print(f"Protocol {protocol.key}: {protocol.describe()}.", flush=True)
    store = Store(options.out)
    assets = [entry.name for entry in entries]
    missing = {} if options.tables_only else _run(options, protocol, assets, wanted, store)
    known = {(r.asset, r.method, r.skeleton): r for r in store if r.protocol == protocol.key}
    lpips = "" if options.lpips else " LPIPS was not measured: no weights were given (`--lpips`)."
    parts = [f"{protocol.describe()}; our jobs: preset `{options.preset}`, guidance `{options.guidance}`.{lpips}"]
    parts += [table_text(table, assets, known) for table in wanted]
    parts.append(tuning_text(facts))
    if missing:
        parts.append("Left out:\n\n" + "\n".join(f"* `{method}`: {why}." for method, why in missing.items()))
    text = "\n\n".join(parts)
    print("\n" + text)
    if options.write:
        write_between(ROOT / "docs" / "benchmarks.md", "paper", text)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    add = parser.add_argument
    add("--tables", default="", help="keys, separated by commas: vanilla, anchored, isotropic, ablation, skeletons")
    add("--assets", default="", help="names, separated by commas; default all candidates")
    add("--sample", type=int, default=0, help="this many assets, balanced over categories and families")
    add("--method-weights", action="append", default=[], metavar="NAME=FOLDER", help="a row of weights from files")
    add("--guidance", default="elastic", help="of our jobs; `oracle` is perfect images")
    add("--preset", default="standard", help="of our jobs; the paper's own is `paper`, hours on a CPU")
    add("--splats", type=int, default=Protocol.splats)
    add("--frames", type=int, default=24)
    add("--views", type=int, default=6)
    add("--size", type=int, default=Protocol.size, help="pixels across a picture")
    add("--lpips", type=Path, default=os.environ.get("GSKIN_LPIPS"), help="TorchScript file; see quality/lpips_file.py")
    add("--fine-tuned", type=Path, help="fine_tuned.json of `gskin train-guidance tune`")
    add("--jobs", type=int, default=1, help="processes")
    add("--tables-only", action="store_true", help="run nothing")
    add("--write", action="store_true", help="put the tables into docs/benchmarks.md")
    add("--out", type=Path, default=ROOT / "out" / "bench-paper", help="folder of the cache")
    return parser.parse_args()


def _chosen(found: list[Table], keys: str) -> list[Table]:
    known = {table.key: table for table in found}
    strange = [key for key in keys.split(",") if key and key not in known]
    if strange:
        raise InputError(f"There is no table '{strange[0]}'; choose of {', '.join(known)}.")
    return [known[key] for key in keys.split(",")] if keys else found


def _run(
    options: argparse.Namespace, protocol: Protocol, assets: list[str], wanted: list[Table], store: Store
) -> dict[str, str]:
    """Run what the store lacks; method -> why it was left out."""
    rows = list(dict.fromkeys((row.case, row.method) for table in wanted for row in table.rows))
    unnamed = {m for _, m in rows if m.startswith(from_file.PREFIX) and from_file.folder_of(m) is None}
    rows = [(case, method) for case, method in rows if method not in unnamed]
    tasks = []
    for asset in assets:
        for case in dict.fromkeys(case for case, _ in rows):
            methods = [m for c, m in rows if c == case and _lacks(store, (asset, m, case, protocol.key), options.lpips)]
            if methods:
                tasks.append(Task(asset, case, order_methods(methods)))
    total, done = sum(len(task.methods) for task in tasks), 0
    missing: dict[str, str] = {}

    def report(result: Result) -> None:
        nonlocal done
        done += 1
        store.add(result)
        print(
            f"{done}/{total} {result.asset} [{result.skeleton}] {result.method}: PSNR {result.score['psnr']:.2f}, "
            f"{result.seconds or 0:.0f} core-s{'' if result.status == 'ok' else ' ' + result.status.upper()}"
            f"{' - ' + result.note if result.note else ''}",
            flush=True,
        )

    run_tasks(
        tasks, protocol, options.out, jobs=options.jobs, lpips=options.lpips, report=report,
        missing=lambda method, why: missing.setdefault(method, why),
    )  # fmt: skip
    for method in sorted(unnamed):
        name = method.removeprefix(from_file.PREFIX)
        missing[method] = f"no folder was given (`--method-weights {name}=FOLDER`)"
    return missing


def _lacks(store: Store, key: tuple[str, str, str, str], lpips: Path | None) -> bool:
    result = store.get(key)
    return result is None or from_file.is_stale(result) or (lpips is not None and result.score["lpips"] is None)


if __name__ == "__main__":
    sys.exit(main())
