# SPDX-License-Identifier: GPL-3.0-or-later
"""Online Manual: every button leads to a place that is there."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")

import gskin_addon
from gskin_addon import registration
from gskin_addon.session import guidance_settings
from gskin_addon.session.properties import GSkinSettings
from gskin_addon.ui import manual
from gskin_addon.ui.preferences import GSkinPreferences

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def pages(tmp_path):
    """The extension's folder with the manual in it, as the archive has it."""
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from manual_pages import write_pages
    finally:
        sys.path.remove(str(ROOT / "tools"))
    write_pages(ROOT / "docs", tmp_path / "manual")
    shutil.copy2(ROOT / "gskin_addon" / "blender_manifest.toml", tmp_path)
    return tmp_path


@pytest.fixture
def registered(pages, monkeypatch):
    where = manual.address(pages)
    monkeypatch.setattr(manual, "address", lambda: where)
    gskin_addon.register()
    yield where
    gskin_addon.unregister()


def operators() -> list[type]:
    classes = [cls for module in registration.MODULES for cls in module.CLASSES]
    return [cls for cls in classes if issubclass(cls, bpy.types.Operator)]


def asked(rna_id: str) -> str | None:
    """As the menu entry does it."""
    return bpy.types.WM_OT_doc_view_manual._lookup_rna_url(rna_id, verbose=False)


def check(url: str | None, where: str) -> None:
    assert url is not None
    assert url.startswith(where)
    path, _, place = url.removeprefix("file://").partition("#")
    assert f'id="{place}"' in Path(path).read_text(), url


def test_every_operator_has_its_place(registered):
    found = operators()
    assert len(found) > 20
    for cls in found:
        check(asked(f"bpy.ops.{cls.bl_idname}"), registered)
    assert asked("bpy.ops.gskin.compare_weights").endswith("#after-a-job")


def test_every_setting_has_its_place(registered):
    for cls in (GSkinSettings, GSkinPreferences, *guidance_settings.CLASSES):
        names = cls.__annotations__
        assert names
        for name in names:
            check(asked(f"bpy.types.{cls.__name__}.{name}"), registered)


def test_nothing_is_left_behind(registered):
    gskin_addon.unregister()
    assert asked("bpy.ops.gskin.auto_skin") is None
    gskin_addon.register()


def test_a_published_release_leads_to_its_site(pages):
    manifest = pages / "blender_manifest.toml"
    manifest.write_text('website = "https://example.org/docs"\n' + manifest.read_text())
    assert manual.address(pages) == "https://example.org/docs/"


def test_a_source_tree_has_no_pages(tmp_path):
    shutil.copy2(ROOT / "gskin_addon" / "blender_manifest.toml", tmp_path)
    assert manual.address(tmp_path) == ""


def test_the_pages_read_well(pages):
    text = (pages / "manual" / "artists" / "index.html").read_text()
    assert "<b>Auto-Skin Gaussians</b>" in text
    assert not re.search(r"\*\*|\]\(|^\||^#", text, re.M), "no mark of Markdown is left"
    for link, place in re.findall(r'href="([^"#]*)(?:#([^"]*))?"', text):
        if not link.startswith("https://"):
            target = (pages / "manual" / "artists" / link) if link else pages / "manual" / "artists" / "index.html"
            assert not place or f'id="{place}"' in target.read_text(), (link, place)
