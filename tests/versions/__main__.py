# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tests/versions`: the tests that need bpy, under every version of it that the package index has.

Each version has an environment of its own in .venvs (tools/version_venv.py): bpy, numpy and what tests need, no
torch. Tests that need more are skipped, and counted as such; `make test` runs them in the one big environment.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from datetime import date
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from version_venv import PYTHONS, Missing, make

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("tests/blender", "tests/versions")


@dataclass(frozen=True)
class Outcome:
    """What pytest said under one version; `problem` where it said nothing."""

    version: str
    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0
    problem: str = ""

    @property
    def good(self) -> bool:
        return not self.problem and not self.failed and self.passed > 0

    def row(self) -> str:
        """A line of the table."""
        python = "{}.{}".format(*PYTHONS[self.version])
        if self.problem:
            return f"| {self.version} | {python} | {self.problem} | | | |"
        return f"| {self.version} | {python} | {self.passed} | {self.failed} | {self.skipped} | {self.seconds:.0f} |"


def main() -> int:
    """All versions one after the other, then the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make test-versions", description=__doc__.splitlines()[0])
    parser.add_argument("--only", help=f"versions with commas between, of {', '.join(PYTHONS)} (default: all)")
    parser.add_argument("pytest", nargs="*", help="words for pytest, after --")
    options = parser.parse_args()
    versions = options.only.split(",") if options.only else list(PYTHONS)
    if unknown := set(versions) - set(PYTHONS):
        parser.error(f"no version {', '.join(sorted(unknown))}; there are {', '.join(PYTHONS)}")
    out = ROOT / "out" / "versions"
    out.mkdir(parents=True, exist_ok=True)
    outcomes = [try_version(version, out, options.pytest) for version in versions]
    print(f"\n{date.today():%-d %B %Y}, {os.cpu_count()}-core CPU\n")
    print("| bpy | Python | passed | failed | skipped | s |\n|---|---|---|---|---|---|")
    for outcome in outcomes:
        print(outcome.row())
    return 0 if all(outcome.good for outcome in outcomes) else 1


def try_version(version: str, out: Path, words: list[str]) -> Outcome:
    """Run the tests under one version."""
    print(f"\nbpy {version}", flush=True)
    try:
        python = make(version)
    except Missing as problem:
        print(problem, file=sys.stderr)
        return Outcome(version, problem="no environment: see above")
    record = out / f"{version}.xml"
    record.unlink(missing_ok=True)
    command = [str(python), "-m", "pytest", "-p", "no:cacheprovider", "-rs", f"--junitxml={record}"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    # The tests say themselves which Python the worker gets.
    environment.pop("GSKIN_PYTHON", None)
    started = time.monotonic()
    code = subprocess.call([*command, *(words or FOLDERS)], cwd=ROOT, env=environment)
    return read_outcome(version, record, code, time.monotonic() - started)


def read_outcome(version: str, record: Path, code: int, seconds: float) -> Outcome:
    """The counts in pytest's record of a run; a crash leaves none."""
    if not record.is_file():
        return Outcome(version, problem=f"pytest ended with {code} and no record")
    suites = list(ElementTree.parse(record).getroot().iter("testsuite"))

    def total(name: str) -> int:
        return sum(int(suite.get(name, 0)) for suite in suites)

    failed, skipped = total("failures") + total("errors"), total("skipped")
    outcome = Outcome(version, total("tests") - failed - skipped, failed, skipped, seconds)
    if code != 0 and not failed:
        return Outcome(version, problem=f"pytest ended with {code} though no test failed")
    return outcome


if __name__ == "__main__":
    sys.exit(main())
