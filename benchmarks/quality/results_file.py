# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of one method as a JSON file that others can read and compare; docs/benchmark-protocol.md has the layout."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.errors import InputError

from .judge import Score
from .protocol import VERSION as JUDGE_VERSION
from .protocol import Protocol
from .results import FAILED, OK, PARTLY, Result

SCHEMA, VERSION = "gskin-skinning-benchmark", 1
SCORES = tuple(field.name for field in fields(Score))


def results_document(
    method: str,
    protocol: Protocol,
    results: Sequence[Result],
    missing: Mapping[str, str],
    digests: Mapping[str, str],
) -> dict[str, Any]:
    """The document. missing: asset -> why it has no result; digests: asset -> `export.splats_digest`."""
    entries = [
        {
            "asset": r.asset, "category": r.category, "family": r.family, "skeleton": r.skeleton, "bones": r.bones,
            "splats_sha256": digests[r.asset], "status": r.status, "note": r.note, "seconds": r.seconds,
            "score": {name: r.score[name] for name in SCORES},
        }
        for r in results
    ]  # fmt: skip
    return {
        "schema": SCHEMA,
        "version": VERSION,
        "method": method,
        "protocol": {"key": protocol.key, "judge": JUDGE_VERSION, **asdict(protocol)},
        "assets": entries,
        "missing": dict(missing),
        "mean": {name: _mean([r.score[name] for r in results]) for name in SCORES},
    }


def read_results(path: Path) -> dict[str, Any]:
    """A results file, checked.

    Raises:
        InputError: missing, no such file, another version, an asset that comes twice, a score that is missing or no
            finite number, a mean that is not that of the assets.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"'{path}' cannot be read ({error}); give a results file.") from None
    fault = _fault(document)
    if fault:
        raise InputError(f"'{path}' is no results file of version {VERSION}: {fault}; write it again.")
    return dict(document)


def _fault(document: Any) -> str:
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        return f"its schema is not '{SCHEMA}'"
    if type(document.get("version")) is not int or document["version"] != VERSION:
        return f"it has version {document.get('version')!r}"
    if not isinstance(document.get("method"), str) or not document["method"]:
        return "it names no method"
    protocol = document.get("protocol")
    if not isinstance(protocol, dict) or not {"key", "judge"} <= set(protocol):
        return "its protocol has no key and judge"
    if not isinstance(document.get("missing"), dict):
        return "it has no table of what is missing"
    entries = document.get("assets")
    if not isinstance(entries, list):
        return "it has no list of assets"
    for entry in entries:
        if (
            not isinstance(entry, dict)
            or not isinstance(entry.get("score"), dict)
            or not isinstance(entry.get("asset"), str)
        ):
            return "an asset has no score"
        if entry.get("status") not in (OK, PARTLY, FAILED):
            return f"'{entry['asset']}' has the status {entry.get('status')!r}"
        for name in SCORES:
            value = entry["score"].get(name)
            if value is None and name == "lpips":
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                return f"'{entry['asset']}' has the {name} {value!r}"
    names = [entry["asset"] for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        return f"'{twice}' comes twice"
    return _wrong_mean(document.get("mean"), [entry["score"] for entry in entries])


def _wrong_mean(mean: Any, scores: Sequence[Mapping[str, Any]]) -> str:
    """What is wrong with the means, which are those of the assets."""
    if not isinstance(mean, dict):
        return "it has no means"
    for name in SCORES:
        wanted, given = _mean([score.get(name) for score in scores]), mean.get(name)
        if wanted is None or given is None:
            agrees = wanted is given
        else:
            number = isinstance(given, int | float) and not isinstance(given, bool)
            agrees = number and math.isclose(given, wanted, rel_tol=1e-6, abs_tol=1e-9)
        if not agrees:
            return f"its mean {name} is {given!r}, that of its assets {wanted!r}"
    return ""


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
