# SPDX-License-Identifier: GPL-3.0-or-later
"""The arrows of the source: which part may know which."""

from __future__ import annotations

import graphlib
import sys
from pathlib import Path

import pytest
from import_graph import Import, Tree

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "gskin_addon"

LAYERS = {
    "core": set(),
    "scene": {"core"},
    "session": {"scene", "core"},
    "ui": {"session", "scene", "core"},
    "operators": {"session", "scene", "core"},
    "commands": {"session", "scene", "core"},
    "cli": {"commands", "core"},
    "registration": {"operators", "ui", "session", "scene", "core"},
    # The package itself registers, and has the hook by which Blender's glTF exporter finds the splats.
    "": {"registration", "scene"},
}
"""What each part of the package may import, besides itself."""

ALLOWED = {("operators.command_line", "cli")}  # Blender's own command line is registered as an operator is

ORDER = (
    ("errors",), ("ticks",), ("files",), ("checkpoint",), ("splats",), ("rig",), ("render",), ("skinning",),
    ("skeleton",), ("guidance",), ("job",), ("pipeline",),
    ("training", "worker"),
)  # fmt: skip
"""The rooms of core: each may import those before it, not those beside or after it."""

BLENDER = {"bpy", "bpy_extras", "mathutils", "bmesh", "gpu", "gpu_extras", "blf", "bl_math", "idprop", "io_scene_gltf2"}

NUMPY_ONLY = ("core.errors", "core.files", "core.splats", "core.rig", "core.skinning.learned", "core.skeleton")
"""What importing these imports is numpy and the standard library, however deep it goes."""

@pytest.fixture(scope="module")
def tree() -> Tree:
    return Tree(ROOT / PACKAGE)


def part(module: str) -> str:
    """The layer of a module of the package."""
    return module.split(".")[1] if "." in module else ""


def room(module: str) -> str:
    """The room of core that a module is in; "" for core itself."""
    return ".".join(module.split(".")[2:3])


def said(tree: Tree, found: Import) -> str:
    return f"{found.source}:{found.line} imports {tree.target(found)}"


def wrong_layers(tree: Tree) -> list[str]:
    wrong = []
    for found in tree.imports:
        target = tree.target(found)
        if target not in tree.files:
            continue
        layer, other = part(found.source), part(target)
        if layer != other and other not in LAYERS[layer]:
            own = found.source.split(".", 1)[1] if "." in found.source else ""
            if (own, other) not in ALLOWED:
                wrong.append(said(tree, found))
    return list(dict.fromkeys(wrong))


def wrong_rooms(tree: Tree) -> list[str]:
    place = {name: number for number, names in enumerate(ORDER) for name in names}
    wrong = []
    for found in tree.imports:
        target = tree.target(found)
        if target in tree.files and part(found.source) == part(target) == "core" and room(found.source):
            own, other = room(found.source), room(target)
            # A room that ORDER does not name is wrong on both ends.
            if own != other and place.get(other, len(ORDER)) >= place.get(own, -1):
                wrong.append(said(tree, found))
    return list(dict.fromkeys(wrong))


def circle(tree: Tree) -> list[str]:
    """The modules of a circle of imports; empty where there is none."""
    try:
        graphlib.TopologicalSorter(tree.early()).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def blender_in_core(tree: Tree) -> list[str]:
    return [said(tree, i) for i in tree.imports if part(i.source) == "core" and i.target.split(".")[0] in BLENDER]


def heavy(tree: Tree) -> set[str]:
    known = sys.stdlib_module_names | {"numpy"}
    rooms = tuple(f"{PACKAGE}.{name}" for name in NUMPY_ONLY)
    return {
        name.split(".", 1)[1]
        for name, brought in tree.brought().items()
        if any(name == room or name.startswith(room + ".") for room in rooms) and brought - known
    }


def test_the_layers_know_only_what_is_below_them(tree):
    assert not wrong_layers(tree)
    assert {part(name) for name in tree.files} == set(LAYERS)


def test_the_rooms_of_core_know_only_those_before_them(tree):
    assert {room(name) for name in tree.files if part(name) == "core"} - {""} == {n for names in ORDER for n in names}
    assert not wrong_rooms(tree)


def test_nothing_is_imported_in_a_circle(tree):
    assert not circle(tree)


def test_core_runs_without_blender(tree):
    assert not blender_in_core(tree)


def test_what_blenders_python_must_import_needs_numpy_only(tree):
    assert not heavy(tree)


def test_inside_the_package_imports_are_relative(tree):
    """An extension is imported under another name than its folder's."""
    assert not [said(tree, i) for i in tree.imports if not i.relative and i.target.split(".")[0] == PACKAGE]


@pytest.mark.parametrize("folder", [PACKAGE, "benchmarks", "demo", "tools", "tests"])
def test_what_is_imported_from_the_package_is_there(tree, folder):
    """Also in functions and in scripts that no test runs."""
    assert not [said(tree, found) for found in Tree(ROOT / folder).imports if tree.lacks(found)]


def made_up(tmp_path: Path, **files: str) -> Tree:
    """A package of modules by their name, "__" for a dot."""
    for name, text in files.items():
        path = tmp_path / PACKAGE / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for folder in (tmp_path / PACKAGE).rglob("*"):
        if folder.is_dir():
            (folder / "__init__.py").touch()
    (tmp_path / PACKAGE / "__init__.py").touch()
    return Tree(tmp_path / PACKAGE)


def test_wrong_arrows_are_found_wherever_they_are_written(tmp_path):
    lazy = "def draw():\n    from ..operators import go\n"
    typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..scene.mesh import Mesh\n"
    tree = made_up(tmp_path, ui__panel=lazy, operators__go="", core__splats__cloud="", scene__mesh="", core__rig=typed)
    assert wrong_layers(tree) == [
        f"{PACKAGE}.core.rig:3 imports {PACKAGE}.scene.mesh",
        f"{PACKAGE}.ui.panel:2 imports {PACKAGE}.operators.go",
    ]
    backward = "def f():\n    from ..rig.lbs import skin\n"
    beside = "from ..worker import client\n"
    files = {"core__splats__a": backward, "core__rig__lbs": "", "core__training__b": beside, "core__worker__client": ""}
    tree = made_up(tmp_path / "b", **files)
    assert wrong_rooms(tree) == [
        f"{PACKAGE}.core.splats.a:2 imports {PACKAGE}.core.rig.lbs",
        f"{PACKAGE}.core.training.b:1 imports {PACKAGE}.core.worker.client",
    ]


def test_circles_heavy_and_missing_imports_are_found(tmp_path):
    tree = made_up(tmp_path, core__rig__a="from .b import B", core__rig__b="from . import a")
    assert set(circle(tree)) == {f"{PACKAGE}.core.rig.a", f"{PACKAGE}.core.rig.b"}
    later = "def f():\n    from . import a\n    import bpy, scipy\n"
    heavy_one = {"core__splats__c": "import torch.nn"}
    tree = made_up(tmp_path / "b", core__rig__a="from .b import B", core__rig__b=later, **heavy_one)
    assert not circle(tree)
    assert blender_in_core(tree) == [f"{PACKAGE}.core.rig.b:3 imports bpy"]
    assert heavy(tree) == {"core.splats.c"}
    assert [found.name for found in tree.imports if tree.lacks(found)] == ["B"]
    tree = made_up(tmp_path / "c", core__rig__a="from ..splats import c", **heavy_one)
    assert heavy(tree) == {"core.rig.a", "core.splats.c"}
