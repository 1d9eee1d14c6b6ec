# SPDX-License-Identifier: GPL-3.0-or-later
"""Check a folder of weights and judge it: `python -m benchmarks.quality.submission FOLDER --name NAME`.

Prints a line for each asset that the folder lacks or whose file is wrong; with --check-only nothing is rendered. Writes
the results file. Exit status: 0 all assets are there and right, 1 some are not, 2 nothing could be done.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from benchmarks.assets import load_asset
from gskin_addon.core.errors import InputError
from gskin_addon.core.files import write_json

from .catalog import Entry
from .export import chosen_entries, splats_digest
from .methods import from_file
from .protocol import Protocol
from .results import Result
from .results_file import results_document
from .runner import run_tasks
from .submitted import SUFFIXES, read_submitted
from .work import Task


def main() -> int:
    """See the module."""
    options = _parse()
    protocol = Protocol(
        splats=options.splats, picture_frames=options.picture_frames, views=options.views, size=options.size
    )
    try:
        entries = chosen_entries(options.assets, options.sample)
        (method,) = from_file.register([f"{options.name}={options.folder}"])
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    digests, missing = check(options.folder, entries, protocol)
    for asset, why in missing.items():
        print(f"{asset}: {why}")
    for name in strangers(options.folder, entries):
        print(f"{name}: no asset of this run; it is not looked at")
    print(f"{len(digests)} of {len(entries)} assets are right.", flush=True)
    if not digests:
        return 2
    if not options.check_only:
        results = judge(method, list(digests), protocol, options.out.parent, options.lpips, options.jobs)
        write_json(options.out, results_document(options.name, protocol, results, missing, digests))
        print(f"'{options.out}' written.")
    return 1 if missing else 0


def check(folder: Path, entries: list[Entry], protocol: Protocol) -> tuple[dict[str, str], dict[str, str]]:
    """Asset -> digest of its splats, for right files; asset -> what is wrong, for the others."""
    right: dict[str, str] = {}
    wrong: dict[str, str] = {}
    for entry in entries:
        asset = load_asset(entry.name, protocol.splats, protocol.seed, unused_bones=protocol.unused_bones)
        try:
            read_submitted(folder, asset)
        except (FileNotFoundError, InputError) as error:
            wrong[entry.name] = str(error)
        else:
            right[entry.name] = splats_digest(asset)
    return right, wrong


def strangers(folder: Path, entries: list[Entry]) -> list[str]:
    """Files of weights whose names are those of no entry."""
    known = {entry.name for entry in entries}
    return sorted(path.name for path in folder.iterdir() if path.suffix in SUFFIXES and path.stem not in known)


def judge(
    method: str, assets: list[str], protocol: Protocol, folder: Path, lpips: Path | None, jobs: int
) -> list[Result]:
    """The results of a registered method, by asset; folder: where the weights are kept for pictures."""
    found: list[Result] = []

    def report(result: Result) -> None:
        found.append(result)
        score = result.score
        print(f"{result.asset}: error {score['error']:.3f} %, PSNR {score['psnr']:.2f}", flush=True)

    run_tasks(
        [Task(asset, "own", (method,)) for asset in assets], protocol, folder, jobs=jobs, lpips=lpips,
        report=report, missing=lambda name, why: print(f"{name}: {why}", flush=True),
    )  # fmt: skip
    return sorted(found, key=lambda result: result.asset)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.submission", description=__doc__)
    add = parser.add_argument
    add("folder", type=Path, help="<asset>.npz or <asset>.txt for each asset")
    add("--name", default="submission", help="the method's name in the results")
    add("--assets", default="", help="names, separated by commas; default all candidates")
    add("--sample", type=int, default=0, help="this many, balanced over categories and families")
    add("--splats", type=int, default=Protocol.splats)
    add("--picture-frames", type=int, default=Protocol.picture_frames)
    add("--views", type=int, default=Protocol.views)
    add("--size", type=int, default=Protocol.size)
    add("--lpips", type=Path, default=os.environ.get("GSKIN_LPIPS"), help="TorchScript file; see lpips.py")
    add("--jobs", type=int, default=1, help="processes")
    add("--check-only", action="store_true", help="judge nothing")
    add("--out", type=Path, default=Path("out/submission/results.json"))
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
