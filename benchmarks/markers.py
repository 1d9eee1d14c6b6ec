# SPDX-License-Identifier: GPL-3.0-or-later
"""Measured text goes between markers of a Markdown file."""

from __future__ import annotations

import os
from pathlib import Path


def write_between(path: Path, name: str, text: str) -> None:
    """Put `text` between the markers <!-- name:begin --> and <!-- name:end --> of a file. ValueError without them."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    whole = path.read_text(encoding="utf-8")
    if begin not in whole or end not in whole:
        raise ValueError(f"'{path}' lacks the markers {begin} and {end}")
    head, _, rest = whole.partition(begin)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(f"{head}{begin}\n{text}\n{end}{rest.partition(end)[2]}", encoding="utf-8")
    os.replace(temporary, path)
