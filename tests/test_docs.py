# SPDX-License-Identifier: GPL-3.0-or-later
"""What the documentation names is there: paths, functions, links, and the messages of the troubleshooting page."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gskin_addon"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [*DOCS, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]

# The start of a path in our own tree, or a Python file of whatever place.
_OURS = re.compile(r"(gskin_addon|core|scene|session|operators|ui|commands|tests|benchmarks|tools|demo)/")
_CODE = re.compile(r"`([^`\n]+)`")
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_QUOTED = re.compile(r'"([^"\n]+)"')
_GAP = "…"


def text_of(path: Path) -> str:
    """A page without its blocks of code, which are examples."""
    return re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)


@cache
def files_called(name: str) -> tuple[Path, ...]:
    """Our Python files with this name or this end of their path."""
    folders = (PACKAGE, ROOT / "benchmarks", ROOT / "demo", ROOT / "tests", ROOT / "tools")
    end = Path(name).parts
    found = (path for folder in folders for path in folder.rglob(end[-1]))
    return tuple(path for path in found if path.parts[-len(end) :] == end)


def places(name: str) -> list[Path]:
    """The files and folders that a path in the documentation stands for."""
    for folder in (ROOT, PACKAGE):
        if "*" in name:
            found = sorted(folder.glob(name))
            if found:
                return found
        elif (folder / name).exists():
            return [folder / name]
    return list(files_called(name)) if name.endswith(".py") else []


def named_paths(text: str) -> Iterator[tuple[str, str]]:
    """(path, names in it) of the code spans that are paths of ours: `core/rig/lbs.py: skin_points, skin_quats`."""
    for span in _CODE.findall(text):
        path, _, names = span.partition(": ")
        if re.fullmatch(r"[\w./*]+", path) and (_OURS.match(path) or path.endswith(".py")):
            yield path, names


def wrong_paths(text: str) -> list[str]:
    wrong = []
    for path, names in named_paths(text):
        found = places(path.rstrip("/"))
        if not found:
            wrong.append(path)
            continue
        for name in re.findall(r"[A-Za-z_]\w*", names):
            if not any(re.search(rf"\b{name}\b", file.read_text(encoding="utf-8")) for file in found if file.is_file()):
                wrong.append(f"{path}: {name}")
    return wrong


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and the site make it."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
    return re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", plain))


def anchors(page: Path) -> set[str]:
    return {slug(heading) for heading in re.findall(r"^#+ (.+)$", text_of(page), re.M)}


def wrong_links(page: Path, text: str) -> list[str]:
    wrong = []
    for link in _LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = page if not name else (page.parent / name).resolve()
        outside = page.parent.name == "docs" and not target.is_relative_to(page.parent)
        # The site has docs/ only.
        if not target.exists() or outside or (anchor and anchor not in anchors(target)):
            wrong.append(link)
    return wrong


@cache
def sentences() -> tuple[str, ...]:
    """All strings of the package, the values in f-strings as gaps."""
    found = []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else _GAP for part in node.values)
                found.append("".join(map(str, parts)))
    return tuple(found)


def is_said(message: str) -> bool:
    """Whether one string of the package has the message's words in this order; its gaps may hold anything."""
    parts = message.split(_GAP)
    pattern = re.compile(".*".join(map(re.escape, parts)), re.S)
    return any(all(part in sentence for part in parts) and pattern.search(sentence) for sentence in sentences())


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_paths_and_names_are_there(page):
    assert not wrong_paths(text_of(page))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_relative_links_work(page):
    assert not wrong_links(page, text_of(page))


def test_messages_of_the_troubleshooting_page_are_the_sources():
    first = [row.split("|")[1] for row in text_of(ROOT / "docs/troubleshooting.md").splitlines() if row[:1] == "|"]
    messages = [message for cell in first for message in _QUOTED.findall(cell)]
    assert len(messages) > 30
    assert not [message for message in messages if not is_said(message)]


def test_every_page_is_in_the_sites_navigation():
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert sorted(re.findall(r": ([\w-]+\.md)$", site, re.M)) == sorted(page.name for page in DOCS)


def test_faults_are_found(tmp_path):
    text = "`core/rig/lbs.py: skin_points`, `core/rig/gone.py`, `core/rig/lbs.py: gone`, `scene/`, `core/*.py`, `x.py`"
    assert wrong_paths(text) == ["core/rig/gone.py", "core/rig/lbs.py: gone", "x.py"]
    page = tmp_path / "docs/page.md"
    page.parent.mkdir()
    page.write_text("# One `word`, *two*\n")
    (tmp_path / "README.md").touch()
    text = "[a](page.md#one-word-two) [b](#gone) [c](gone.md) [d](https://x.y) [e](../README.md)"
    assert wrong_links(page, text) == ["#gone", "gone.md", "../README.md"]
    assert is_said("An object is in Edit Mode: leave it")
    assert is_said("'…' was changed while")
    assert not is_said("It was changed by the moon …")
