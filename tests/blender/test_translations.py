# SPDX-License-Identifier: GPL-3.0-or-later
"""The words of the interface: all of them are collected, and a translation fits what it translates."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon.ui import translations

TOOLS = Path(__file__).resolve().parents[2] / "tools"
GERMAN = translations.FOLDER / "de.po"


@pytest.fixture(scope="module")
def collector():
    sys.path.insert(0, str(TOOLS))
    try:
        import collect_words

        yield collect_words
    finally:
        sys.path.remove(str(TOOLS))


@pytest.fixture
def registered():
    gskin_addon.register()
    yield
    gskin_addon.unregister()


def test_template_and_translations_are_up_to_date(collector, registered):
    """If not: `make words`."""
    words = collector.collect()
    assert ("Operator", "Auto-Skin Gaussians") in words
    assert ("Operator", "Load...") in words
    assert ("*", "Least sure {share}: below {bound}") in words
    assert ("*", "Strays") in words
    assert collector.TEMPLATE.read_text(encoding="utf-8") == collector.as_po(words, {}, "")
    for path in translations.FOLDER.glob("*.po"):
        kept = translations.read_po(path)
        assert path.read_text(encoding="utf-8") == collector.as_po(words, kept, path.stem)


def test_german_is_there(collector):
    german = translations.read_po(GERMAN)
    said = [key for key, text in german.items() if text]
    assert len(said) > 0.9 * len(german), [key for key, text in german.items() if not text]
    assert german["Operator", "Compare Weights"] == "Gewichte vergleichen"


def test_a_translation_has_the_same_gaps():
    for (_, text), translated in translations.read_po(GERMAN).items():
        if translated:
            assert sorted(re.findall(r"\{\w*\}", text)) == sorted(re.findall(r"\{\w*\}", translated)), text


def test_quotes_and_lines_are_read(tmp_path, collector):
    words = {("*", 'A "quoted" word'): "Ein „zitiertes“ Wort", ("*", "x"): ""}
    words["Operator", "Two\nlines"] = "Zwei\nZeilen"
    path = tmp_path / "xx.po"
    path.write_text(collector.as_po(sorted(words), words, "xx"), encoding="utf-8")
    assert translations.read_po(path) == words
    path.write_text('msgctxt "*"\nmsgid ""\n"in "\n"parts"\nmsgstr "in Teilen"\n', encoding="utf-8")
    assert translations.read_po(path) == {("*", "in parts"): "in Teilen"}


def test_what_is_not_translated_stays_english(registered):
    assert translations.tr("No such word {here}") == "No such word {here}"
    assert all(text for words in translations.dictionary().values() for text in words.values())
    assert set(translations.dictionary()) == {"de", "de_DE"}


def test_blender_translates_where_it_can(registered, monkeypatch):
    if "de_DE" not in bpy.app.translations.locales and "de" not in bpy.app.translations.locales:
        pytest.skip("this bpy is built without translations")
    view = bpy.context.preferences.view
    language = next(name for name in ("de", "de_DE") if name in bpy.app.translations.locales)
    monkeypatch.setattr(view, "language", language)
    assert translations.tr("Compare Weights", translations.BUTTON) == "Gewichte vergleichen"
