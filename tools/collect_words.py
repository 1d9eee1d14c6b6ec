# SPDX-License-Identifier: GPL-3.0-or-later
"""Collect all words of the interface into a gettext template, and bring the translations up to date with it.

.venv/bin/python tools/collect_words.py [--check]

New words come into the .po files without a translation, words that are gone leave them. --check writes nothing and
fails where something would change.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import gskin_addon  # noqa: E402
from gskin_addon import registration  # noqa: E402
from gskin_addon.ui.translations import ANY, BUTTON, FOLDER, Words, read_po  # noqa: E402

TEMPLATE = FOLDER / "words.pot"
DRAWN = ("ui", "session")
"""Layers whose source is searched for words; operators draw nothing but their properties."""

_LICENCE = "# SPDX-License-Identifier: GPL-3.0-or-later"
_HEADER = _LICENCE + '\nmsgid ""\nmsgstr ""\n"Content-Type: text/plain; charset=UTF-8\\n"\n"Language: {}\\n"\n'


def words_of_classes() -> Iterator[tuple[str, str]]:
    """Labels, tips, names and choices of all registered classes."""
    for module in registration.MODULES:
        for cls in module.CLASSES:
            rna: Any = cls.bl_rna
            if issubclass(cls, bpy.types.Operator):
                group, name = cls.bl_idname.split(".")
                rna = getattr(getattr(bpy.ops, group), name).get_rna_type()
                yield BUTTON, cls.bl_label
                yield ANY, rna.description
            own = {name for base in cls.__mro__ if _ours(base) for name in inspect.get_annotations(base)}
            for prop in rna.properties:
                if prop.identifier in own and not prop.is_hidden:
                    yield from _words_of(prop)
    # Properties of our own that Blender's kinds of data have been given.
    for kind in (bpy.types.Scene, bpy.types.Object):
        data: Any = kind.bl_rna
        for prop in data.properties:
            if prop.identifier.startswith("gskin_"):
                yield from _words_of(prop)


def _words_of(prop: Any) -> Iterator[tuple[str, str]]:
    if prop.name != prop.identifier:  # it has been given one
        yield ANY, prop.name
    yield ANY, prop.description
    if prop.type == "ENUM":
        for item in prop.enum_items:
            yield ANY, item.name
            yield ANY, item.description


def words_of_source(text: str) -> Iterator[tuple[str, str]]:
    """Constant texts of what is drawn (`text=`), of `tr`, and of checks and remedies."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Tuple) and len(node.elts) == 2:  # a list of buttons: (operator, what it says)
            operator, said = (list(_constants(part)) for part in node.elts)
            if operator and said and operator[0].startswith("gskin.") and "." not in said[0]:
                yield BUTTON, said[0]
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        button = BUTTON if name.startswith("operator") else ANY
        for keyword in node.keywords:
            if keyword.arg == "text":
                yield from ((button, word) for word in _constants(keyword.value))
        if name == "tr":
            context = BUTTON if len(node.args) > 1 else ANY
            yield from ((context, word) for word in _constants(node.args[0]))
        elif name in ("Check", "Remedy"):
            first, *others = node.args if name == "Check" else [ast.Constant(""), ast.Constant(""), *node.args]
            yield from ((ANY, word) for word in _constants(first))
            if len(others) > 1:
                yield from ((ANY, word) for word in _constants(others[1]))
            if len(others) > 3:
                yield from ((BUTTON, word) for word in _constants(others[3]))
    for node in ast.walk(ast.parse(text)):
        # A panel's label (the class of presets has the last preset's name), or a sentence made before its check.
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") in ("bl_label", "sentence"):
            yield from ((ANY, word) for word in _constants(node.value))


def collect() -> list[tuple[str, str]]:
    """(context, text) of all words, sorted; the add-on must be registered."""
    found = set(words_of_classes())
    for layer in DRAWN:
        for path in sorted((ROOT / "gskin_addon" / layer).glob("*.py")):
            found |= set(words_of_source(path.read_text(encoding="utf-8")))
    return sorted((context, text) for context, text in found if any(letter.isalpha() for letter in text))


def as_po(words: list[tuple[str, str]], translated: Words, language: str) -> str:
    """A .po file, or with an empty language a template."""
    entries = [_HEADER.format(language)]
    for context, text in words:
        lines = [f"msgctxt {_quoted(context)}", f"msgid {_quoted(text)}"]
        entries.append("\n".join([*lines, f"msgstr {_quoted(translated.get((context, text), ''))}"]) + "\n")
    return "\n".join(entries)


def main() -> int:
    """Write what changed; with --check 1 where something would."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail where something would change")
    check = parser.parse_args().check
    gskin_addon.register()
    words = collect()
    gskin_addon.unregister()
    old = 0
    for path in (TEMPLATE, *sorted(FOLDER.glob("*.po"))):
        translated = read_po(path) if path != TEMPLATE else {}
        text = as_po(words, translated, path.stem if path != TEMPLATE else "")
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            old += 1
            print(f"{path.name} {'is not up to date' if check else 'was brought up to date'}")
            if not check:
                path.write_text(text, encoding="utf-8")
        missing = [word for word in words if not translated.get(word)]
        if path != TEMPLATE and missing:
            print(f"{path.name}: {len(missing)} of {len(words)} without a translation")
    return 1 if check and old else 0


def _ours(cls: type) -> bool:
    return cls.__module__.startswith("gskin_addon")


def _constants(node: ast.AST) -> Iterator[str]:
    """The constant texts that an expression may be."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from _constants(node.body)
        yield from _constants(node.orelse)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


if __name__ == "__main__":
    sys.exit(main())
