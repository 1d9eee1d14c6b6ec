# SPDX-License-Identifier: GPL-3.0-or-later
"""The words of panels, buttons and tips in other languages: gettext files of ui/words, read by ourselves.

Blender translates by itself what is constant: labels, names, tips. What has numbers or names in it goes through `tr`. A
word without a translation stays English. tools/collect_words.py brings words.pot and the .po files up to date.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import bpy

FOLDER = Path(__file__).with_name("words")
CLASSES = ()

ANY, BUTTON = "*", "Operator"
"""Contexts of Blender: of everything, and of what an operator's button says."""

Words = dict[tuple[str, str], str]

_LOCALES = {"de": ("de", "de_DE")}
"""By file: the names that the versions of Blender have for the language."""


def tr(text: str, context: str = ANY) -> str:
    """`text` in the language of Blender's interface, for `str.format`; itself where there is no translation."""
    return str(bpy.app.translations.pgettext_iface(text, context))


def read_po(path: Path) -> Words:
    """(context, text) -> translation of the entries of a .po file; "" where one is missing, the header is left out."""
    words: Words = {}
    for entry in re.split(r"\n\s*\n", path.read_text(encoding="utf-8")):
        fields: dict[str, str] = {}
        for keyword, quoted in re.findall(r'^(msgctxt|msgid|msgstr)((?:\s*"(?:[^"\\]|\\.)*")+)', entry, re.M):
            fields[keyword] = "".join(ast.literal_eval(part) for part in re.findall(r'"(?:[^"\\]|\\.)*"', quoted))
        if fields.get("msgid"):
            words[fields.get("msgctxt", ANY), fields["msgid"]] = fields.get("msgstr", "")
    return words


def dictionary(folder: Path = FOLDER) -> dict[str, Words]:
    """What `bpy.app.translations.register` takes; only what is translated is in it."""
    found: dict[str, Words] = {}
    for path in sorted(folder.glob("*.po")):
        words = {key: text for key, text in read_po(path).items() if text}
        for locale in _LOCALES.get(path.stem, (path.stem,)):
            found[locale] = words
    return found


def register() -> None:
    words: Any = dictionary()
    bpy.app.translations.register(__name__, words)


def unregister() -> None:
    bpy.app.translations.unregister(__name__)
