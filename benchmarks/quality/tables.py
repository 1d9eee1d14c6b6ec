# SPDX-License-Identifier: GPL-3.0-or-later
"""The summary as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .catalog import CATEGORIES
from .methods import DESCRIPTIONS
from .perturb import DISTURBANCE_TITLES, DISTURBANCES
from .results import FAILED, OWN, PARTLY
from .summary import BASE, MESH, OURS, Summary

STAGES = (
    ("initial", "the paper's initial weights"),
    ("learned", "learned weights alone"),
    ("ours:learned+none", "a job from learned weights without guidance images"),
    ("ours:learned+elastic", "learned + elastic guidance images + regularisers"),
    ("ours:visibility+elastic", "the paper's initial weights + elastic guidance images + regularisers"),
    ("ours:default", "the default job"),
)
"""Rows of the table in which each stage must earn its place; those without results are left out."""


def main_table(summary: Summary) -> str:
    """Methods x mean scores."""
    lpips = any(np.isfinite(summary.mean(m, "lpips")) for m in summary.methods())
    header = [
        "method", "assets", "error", "95 %", "ratio to initial", "worse than initial", "better than heat_mesh",
        "random error", "95 %", "PSNR", "SSIM", *(["LPIPS"] if lpips else []), "weights L1", "seconds", "partly",
        "failed",
    ]  # fmt: skip
    rows = []
    for method in summary.methods():
        results = summary.of(method)
        mean = lambda field, method=method: summary.mean(method, field)  # noqa: E731
        rows.append([
            f"`{method}`", str(len(results)), _number(mean("error")), _number(mean("error95"), 2),
            "-" if method == BASE else _number(summary.ratio(method), 2),
            "-" if method == BASE else _percent(summary.worse_than_initial(method)),
            "-" if method == MESH else _percent(summary.beats_mesh(method)),
            _number(mean("random_error")), _number(mean("random_error95"), 2),
            _number(mean("psnr"), 2), _number(mean("ssim"), 4), *([_number(mean("lpips"), 4)] if lpips else []),
            _number(mean("l1")), _number(summary.seconds(method), 1),
            str(sum(r.status == PARTLY for r in results)), str(sum(r.status == FAILED for r in results)),
        ])  # fmt: skip
    return _table(header, rows)


def category_table(summary: Summary, field: str, digits: int) -> str:
    """Methods x categories, the mean of a field."""
    counts = {c: max((len(summary.of(m, OWN, c)) for m in summary.methods()), default=0) for c in CATEGORIES}
    header = ["method", *(f"{c} ({counts[c]})" for c in CATEGORIES)]
    rows = [
        [f"`{m}`", *(_number(summary.mean(m, field, category=c), digits) for c in CATEGORIES)]
        for m in summary.methods()
    ]
    return _table(header, rows)


def stage_table(summary: Summary) -> str:
    """What each stage brings, on the assets that have all of them."""
    present = [(m, title) for m, title in STAGES if summary.of(m)]
    if len(present) < 2:
        return ""
    assets = summary.common([m for m, _ in present])
    if not assets:
        return ""
    rows = [
        [title, f"`{m}`", *(_number(summary.mean(m, f, assets=assets), d) for f, d in
         (("error", 3), ("error95", 2), ("random_error", 3), ("psnr", 2), ("ssim", 4), ("l1", 3)))]
        for m, title in present
    ]  # fmt: skip
    head = ["stage", "method", "error", "95 %", "random error", "PSNR", "SSIM", "weights L1"]
    return f"On the {len(assets)} assets that have all of these rows.\n\n{_table(head, rows)}"


def robust_table(summary: Summary, methods: Sequence[str]) -> str:
    """Methods x disturbed skeletons: the mean error, and in how far it grew."""
    skeletons = list(DISTURBANCES)
    present = [m for m in methods if all(summary.of(m, s) for s in skeletons)]
    assets = summary.common(present, skeletons)
    if not assets:
        return ""
    rows = []
    for method in present:
        values = [summary.mean(method, "error", skeleton=s, assets=assets) for s in skeletons]
        cells = [f"{v:.3f} (x {v / values[0]:.2f})" for v in values[1:]]
        rows.append([f"`{method}`", _number(values[0]), *cells])
    head = ["method", *(DISTURBANCE_TITLES[s] for s in skeletons)]
    return f"Mean error on {len(assets)} assets, and its growth.\n\n{_table(head, rows)}"


def failure_list(summary: Summary, most: int = 12) -> str:
    """What failed, or partly; for a method with more than `most` of a kind, the count and the first."""
    groups: dict[tuple[str, str], list[str]] = {}
    for result in summary.failures():
        skeleton = "" if result.skeleton == OWN else f" ({DISTURBANCE_TITLES[result.skeleton]})"
        groups.setdefault((result.method, result.status), []).append(f"{result.asset}{skeleton}: {result.note}")
    if not groups:
        return "None."
    lines = []
    for (method, status), notes in groups.items():
        lines.append(f"* `{method}`, {'failed' if status == FAILED else 'partly failed'} on {len(notes)}:")
        lines += [f"  * {note}" for note in notes[:most]]
        if len(notes) > most:
            lines.append(f"  * and {len(notes) - most} more.")
    return "\n".join(lines)


def method_list(summary: Summary) -> str:
    """What the names mean."""
    lines = []
    for method in summary.methods():
        if method in DESCRIPTIONS:
            text = DESCRIPTIONS[method]
        elif method.startswith("file:"):
            text = f"weights that were given as files for `{method.removeprefix('file:')}`"
        else:
            text = f"the whole job, `init+guidance` = `{method.removeprefix('ours:')}`"
            text = "the whole job as a new user has it" if method == OURS else text
        lines.append(f"* `{method}`: {text}.")
    return "\n".join(lines)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _number(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def _percent(value: float) -> str:
    return f"{value:.0%}" if np.isfinite(value) else "-"
