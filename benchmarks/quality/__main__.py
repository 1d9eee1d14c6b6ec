# SPDX-License-Identifier: GPL-3.0-or-later
"""`make bench-quality`: every way to make weights, on rigged assets whose true weights are known.

Runs what the cache lacks, then prints the tables and rewrites their section of docs/benchmarks.md. A run that is
stopped goes on where it was. Needs the shared assets (or GSKIN_ASSETS).
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from pathlib import Path

from benchmarks.assets import ASSETS
from gskin_addon.core.errors import InputError

from .catalog import CATEGORIES, Entry, balanced, candidates, entry_of, is_open
from .methods import METHODS, from_file
from .perturb import DISTURBANCES
from .protocol import Protocol
from .report import ROBUST_METHODS, page, write_section
from .results import OWN, Result, Store
from .runner import run_tasks
from .summary import OURS, Summary, acceptance
from .work import Task, order_methods

ROOT = Path(__file__).resolve().parents[2]
DOC = ROOT / "docs" / "benchmarks.md"
BASELINES = ("initial", "geodesic", "nearest", "heat_mesh", "heat_proxy", "heat_splats", "bbw")
GUIDED = ("ours:visibility+elastic", "ours:learned+elastic", "oracle")
SLOW = dict.fromkeys(GUIDED, 24)
"""Methods that by default run on the first few assets of the balanced order only."""


def main() -> int:
    """Run, print, write; returns 2 when the assets are not on this machine or a name is wrong."""
    arguments = _parse()
    if not (ASSETS / "catalog.json").is_file():
        return _refuse(f"'{ASSETS}' has no catalog.json; set GSKIN_ASSETS to the folder that holds it and npz/.")
    protocol = Protocol(
        splats=arguments.splats, frames=arguments.frames, picture_frames=arguments.picture_frames,
        views=arguments.views, size=arguments.size, unused_bones=arguments.unused_bones,
    )  # fmt: skip
    try:
        given = from_file.register(arguments.method_weights)
    except InputError as error:
        return _refuse(str(error))
    methods = [*arguments.methods.split(","), *given]
    unknown = [m for m in methods if m not in METHODS and not m.startswith(("ours:", "job:", from_file.PREFIX))]
    if unknown:
        return _refuse(f"There is no method '{unknown[0]}': choose of {', '.join(METHODS)}, ours:<init>+<guidance>.")
    entries = _entries(arguments)
    store = Store(arguments.out)
    print(f"Protocol {protocol.key}: {protocol.describe()}.", flush=True)
    print("LPIPS: " + (str(arguments.lpips) if arguments.lpips else "not measured, no weights given (--lpips)."))
    if not arguments.tables_only:
        _run(arguments, protocol, entries, methods, store)
    _publish(arguments, protocol, entries, store)
    return 0


def _refuse(reason: str) -> int:
    print(reason, file=sys.stderr)
    return 2


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="bench-quality", description=__doc__)
    add = parser.add_argument
    defaults = Protocol()
    add("--methods", default=",".join([*BASELINES, "learned", OURS, *GUIDED]), help="names, separated by commas")
    add("--method-weights", action="append", default=[], metavar="NAME=FOLDER",
        help="also the weights that a folder holds, a file for each asset (docs/benchmark-protocol.md); repeatable")
    add("--assets", default="", help="names, separated by commas; default all candidates")
    add("--categories", default="", help=f"of {', '.join(CATEGORIES)}, separated by commas")
    add("--sample", type=int, default=0, help="this many assets, balanced over categories and families")
    add("--robust", type=int, default=0, metavar="N", help="also disturbed skeletons, on the first N assets")
    add("--splats", type=int, default=defaults.splats)
    add("--frames", type=int, default=defaults.frames)
    add("--picture-frames", type=int, default=defaults.picture_frames, help="of the frames, how many are rendered")
    add("--views", type=int, default=defaults.views)
    add("--size", type=int, default=defaults.size, help="pixels across a picture")
    add("--unused-bones", action="store_true", help="keep bones that carry no weight")
    add("--lpips", type=Path, default=os.environ.get("GSKIN_LPIPS"), help="TorchScript file; see lpips.py")
    add("--jobs", type=int, default=1, help="processes")
    add("--threads", type=int, default=1, help="of each process")
    add("--force", action="store_true", help="run the methods again, whatever the cache has")
    add("--tables-only", action="store_true", help="run nothing, make tables and pictures of what there is")
    add("--no-docs", action="store_true", help="leave docs/ alone; print only")
    add("--show", default=OURS, help="the method of the pictures of best and worst cases")
    add("--out", type=Path, default=ROOT / "out" / "bench-quality", help="folder of the cache")
    return parser.parse_args()


def _entries(arguments: argparse.Namespace) -> list[Entry]:
    """The chosen assets in the balanced order, so that a run that is stopped has a fair part."""
    entries = candidates()
    if arguments.assets:
        entries = [entry_of(name) for name in arguments.assets.split(",")]
    if arguments.categories:
        entries = [e for e in entries if e.category in arguments.categories.split(",")]
    return balanced(entries, arguments.sample or len(entries))


def _run(
    arguments: argparse.Namespace, protocol: Protocol, entries: list[Entry], methods: list[str], store: Store
) -> None:
    tasks = []
    for number, entry in enumerate(entries):
        for skeleton in DISTURBANCES:
            if skeleton != OWN and number >= arguments.robust:
                continue
            wanted = [m for m in methods if skeleton == OWN or m in ROBUST_METHODS]
            wanted = [m for m in wanted if arguments.sample or number < SLOW.get(m, len(entries))]
            if not arguments.force:
                known = {m: store.get((entry.name, m, skeleton, protocol.key)) for m in wanted}
                wanted = [
                    m for m, r in known.items()
                    if r is None or from_file.is_stale(r) or (arguments.lpips and r.score["lpips"] is None)
                ]  # fmt: skip
            if wanted:
                tasks.append(Task(entry.name, skeleton, order_methods(wanted)))
    total, done, started = sum(len(t.methods) for t in tasks), 0, time.monotonic()
    missing: set[tuple[str, str]] = set()

    def report(result: Result) -> None:
        nonlocal done
        done += 1
        store.add(result)
        left = (time.monotonic() - started) / done * (total - done)
        skeleton = "" if result.skeleton == OWN else f" [{result.skeleton}]"
        score = result.score
        print(
            f"{done}/{total} {result.asset}{skeleton} {result.method}: error {score['error']:.3f} "
            f"(random poses {score['random_error']:.3f}), PSNR {score['psnr']:.2f}, "
            f"{'?' if result.seconds is None else f'{result.seconds:.1f}'} s"
            f"{'' if result.status == 'ok' else ' ' + result.status.upper()}"
            f"{' - ' + result.note if result.note else ''}; {left / 60:.0f} min left",
            flush=True,
        )

    def lacking(method: str, why: str) -> None:
        nonlocal total
        total -= 1
        if (method, why) not in missing:
            missing.add((method, why))
            print(f"{method} left out: {why}.", flush=True)

    run_tasks(
        tasks, protocol, arguments.out, jobs=arguments.jobs, threads=arguments.threads,
        lpips=arguments.lpips, report=report, missing=lacking,
    )  # fmt: skip


def _publish(arguments: argparse.Namespace, protocol: Protocol, entries: list[Entry], store: Store) -> None:
    chosen = {e.name for e in entries}
    summary = Summary((r for r in store if r.asset in chosen), protocol.key)
    if not summary.methods():
        print("There are no results for this protocol and these assets.")
        return
    pictures = []
    if not arguments.no_docs:
        from .pictures import make_sheets

        shown = summary.only([entry.name for entry in entries if is_open(entry.name)])
        made = make_sheets(shown, protocol, arguments.out, DOC.parent / "images", arguments.show)
        pictures = [(f"images/{name}", caption) for name, caption in made]
    threads = "one thread" if arguments.threads == 1 else f"{arguments.threads} threads"
    machine = f"{os.cpu_count()}-core {platform.machine()} CPU, {threads} a method, no GPU"
    text = page(summary, protocol, machine, pictures)
    print("\n" + text)
    if not arguments.no_docs:
        write_section(DOC, text)
    print()
    for line in acceptance(summary):
        print(line)


if __name__ == "__main__":
    sys.exit(main())
