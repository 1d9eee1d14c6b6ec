# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's tables as Markdown, with what was not run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality.results import FAILED, OK, PARTLY, Result
from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.lightning_drag.files import read_table

from .rows import Row, Table

Known = Mapping[tuple[str, str, str], Result]
"""(asset, method, case) -> result."""


_SCORES = {"psnr": 2, "ssim": 3, "lpips": 4, "raw_psnr": 2}
"""Of guidance images, with their digits."""


def table_text(table: Table, assets: Iterable[str], known: Known) -> str:
    """A table over the assets that all of its rows with results have; rows without any are named below it."""
    found = {row: {a for a in assets if (a, row.method, row.case) in known} for row in table.rows}
    shown = [row for row in table.rows if found[row]]
    lines = [f"#### {table.title}", ""]
    if shown:
        common = sorted(set.intersection(*(found[row] for row in shown)))
        if not common:
            lines.append("No asset has a result of every row yet.")
        else:
            head = "| row | PSNR | SSIM | LPIPS | error % | not whole | the paper's, on its own assets |"
            lines += [_on(common), "", head, "|---" * 7 + "|"]
            lines += [_line(row, common, known) for row in shown]
    absent = [row.title for row in table.rows if not found[row]]
    if absent:
        lines += ["", f"Not run: {', '.join(absent)}."]
    return "\n".join(lines)


def read_facts(path: Path) -> dict[str, Any]:
    """A fine_tuned.json, whose scores are numbers. Raises InputError."""
    facts = read_table(path)
    scores = facts.get("validation") or {}
    sound = isinstance(scores, dict) and all(isinstance(scores.get(when, {}), dict) for when in ("before", "after"))
    values = [scores.get(when, {}).get(name) for when in ("before", "after") for name in _SCORES] if sound else [""]
    if not all(value is None or type(value) in (int, float) for value in values):
        raise InputError(f"'{path}' has a validation that is no table of scores; give the file that tune wrote.")
    return facts


def tuning_text(facts: Mapping[str, Any] | None) -> str:
    """The table of guidance images before and after fine-tuning; facts: of fine_tuned.json."""
    lines = ["#### Fine-tuning of the generator (guidance images)", ""]
    scores = (facts or {}).get("validation") or {}
    if not {"before", "after"} <= set(scores):
        why = (
            "Not run: it needs diffusion weights. `gskin train-guidance tune` measures images before and after; give "
            "its fine_tuned.json as `--fine-tuned`."
        )
        return "\n".join([*lines, why])
    lines += ["| | PSNR | SSIM | LPIPS | PSNR, raw | the paper's |", "|---" * 6 + "|"]
    papers = {"before": "18.88 / 0.892 / 0.1328", "after": "26.78 / 0.966 / 0.0342"}
    for when, title in (("before", "without fine-tuning"), ("after", "fine-tuned")):
        cells = [_number(scores[when].get(name), digits) for name, digits in
                 _SCORES.items()]  # fmt: skip
        lines.append(f"| {title} | {' | '.join(cells)} | {papers[when]} |")
    return "\n".join(lines)


def _on(assets: list[str]) -> str:
    names = f": {', '.join(assets)}" if len(assets) <= 6 else ""
    return f"{len(assets)} asset{'s' if len(assets) != 1 else ''}{names}."


def _line(row: Row, assets: list[str], known: Known) -> str:
    results = [known[asset, row.method, row.case] for asset in assets]

    def mean(name: str) -> float | None:
        values = [r.score[name] for r in results if r.score[name] is not None]
        return float(np.mean(values)) if values else None

    cells = [_number(mean(name), digits) for name, digits in (("psnr", 2), ("ssim", 4), ("lpips", 4), ("error", 3))]
    lost = [f"{n} {status}" for status in (PARTLY, FAILED) if (n := sum(r.status == status for r in results))]
    assert all(r.status in (OK, PARTLY, FAILED) for r in results)
    paper = "-" if row.paper is None else "{:.2f} / {:.3f} / {:.4f}".format(*row.paper)
    return f"| {row.title} | {' | '.join(cells)} | {', '.join(lost) or '-'} | {paper} |"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
