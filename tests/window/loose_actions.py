# SPDX-License-Identifier: GPL-3.0-or-later
"""Loose actions of several rigs, which Blender before 4.4 does not tell apart: left out with a word, or taken.

blender -b --python-exit-code 1 --python tests/window/loose_actions.py -- --out DIR
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from pathlib import Path
from typing import Any

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import figure_rig as fig
from glb import Glb


def main() -> None:
    """Every step asserts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :])
    options.out.mkdir(parents=True, exist_ok=True)
    slots = hasattr(bpy.types, "ActionSlot")
    source = two(options.out / "two.blend")
    said, clips = export(source, options.out / "two.glb")
    assert clips == ["HeroIdle", "HeroWave"] if slots else clips == ["HeroIdle"], clips
    if not slots:
        assert "2 unused actions ('HeroWave', 'MonsterRoar') may belong to 'Hero' or to 'Monster'" in said, said
    print(f"ok    {bpy.app.version_string}: of two like rigs only what is surely the hero's, {clips}")
    source = two(options.out / "other.blend", rename=True)
    said, clips = export(source, options.out / "other.glb")
    assert clips == ["HeroIdle", "HeroWave"], clips
    assert "may belong" not in said, said
    print(f"ok    {bpy.app.version_string}: of two different rigs the hero's, {clips}")


def two(path: Path, rename: bool = False) -> Path:
    """A hero with an action of its own, and a loose one of each of two rigs; `rename`: of different bones."""
    _, hero = fig.open_base()
    hero.name = "Hero"
    monster: Any = fig.add_rig("Monster")
    if rename:
        for bone in monster.data.bones:
            bone.name = f"monster_{bone.name}"
        fig.key(monster, "location", {1: (0, 0, 0), 10: (0, 0, 1)}, monster.pose.bones[2], "MonsterRoar")
    else:
        fig.wave(monster, "MonsterRoar", 0.4)
    fig.wave(hero, "HeroWave")
    for obj in (hero, monster):
        obj.animation_data.action.use_fake_user = True
        obj.animation_data.action = None
    fig.wave(hero, "HeroIdle", 0.1)
    fig.save(path)
    return path


def export(source: Path, out: Path) -> tuple[str, list[str]]:
    """What `gskin pose` says, and the clips of the .glb that it writes."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        assert fig.run("pose", source, "--out", out) == 0, said.getvalue()
    return said.getvalue(), sorted(clip["name"] for clip in Glb(out).json["animations"])


main()
