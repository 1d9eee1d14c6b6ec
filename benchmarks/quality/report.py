# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of results, and its place in docs/benchmarks.md."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from . import tables
from .protocol import Protocol
from .summary import OURS, Summary, acceptance

BEGIN, END = "<!-- quality:begin -->", "<!-- quality:end -->"

ROBUST_METHODS = ("initial", "geodesic", "heat_mesh", "learned", OURS)


def page(summary: Summary, protocol: Protocol, machine: str, pictures: Sequence[tuple[str, str]]) -> str:
    """All tables in Markdown; pictures: (path in docs, caption)."""
    parts = [
        f"Protocol: {protocol.describe()}; {machine}. Errors are distances to the true posed position in % of the "
        "bounding-box diagonal: mean and 95th percentile over splats and frames of the asset's own animation, and in "
        "random poses (10 % of the joints, 0.1 pi to 0.33 pi). `ratio to initial` is the mean of the assets' ratios. "
        "Where a method leaves splats without weights they follow their nearest bone: `partly`; where it gives none, "
        "all do: `failed`. Both count in the means. Seconds: core-seconds, median of the assets.",
        tables.method_list(summary),
        tables.main_table(summary),
        _on_common_assets(summary),
        "#### By category\n\nMean error:\n\n" + tables.category_table(summary, "error", 3),
        "Mean PSNR:\n\n" + tables.category_table(summary, "psnr", 2),
        _section("Acceptance", "\n".join(f"    {line}" for line in acceptance(summary))),
        _section("Each stage", tables.stage_table(summary)),
        _section("Skeletons that are not quite right", tables.robust_table(summary, ROBUST_METHODS)),
        *(f"![{caption}]({path})\n\n*{caption}*" for path, caption in pictures),
        _section("Failures", tables.failure_list(summary)),
    ]
    return "\n\n".join(part for part in parts if part)


def write_section(path: Path, text: str) -> None:
    """Put `text` between the markers of the file, in place of what is there.

    Raises:
        ValueError: the file lacks the markers.
    """
    old = path.read_text(encoding="utf-8")
    if BEGIN not in old or END not in old:
        raise ValueError(f"'{path}' lacks '{BEGIN}' and '{END}', between which the tables belong.")
    before, rest = old.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    temporary = path.with_suffix(".tmp")
    temporary.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")
    os.replace(temporary, path)


def _on_common_assets(summary: Summary) -> str:
    """The main table again, fair, where not every method ran on every asset."""
    methods = summary.methods()
    common = summary.common(methods)
    if not common or all(len(summary.of(m)) == len(common) for m in methods):
        return ""
    return f"On the {len(common)} assets that all of these methods have:\n\n" + tables.main_table(summary.only(common))


def _section(title: str, text: str) -> str:
    return f"#### {title}\n\n{text}" if text else ""
