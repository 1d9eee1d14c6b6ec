# SPDX-License-Identifier: GPL-3.0-or-later
"""Examples from a folder of rigged assets, the same ones for every training and every check."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...skeleton.joints import HUMAN, QUADRUPED, human_bones, quadruped_bones
from ..catalogue import FREE_LICENCES, Asset, list_assets
from ..rigged import RiggedMesh, read_rigged_mesh
from .examples import Example, change_person, change_quadruped, feet_on_legs, make_example, turned_to_front

FEWEST = 9
"""Joints that the names of a rig must tell."""

CATEGORY = {"human": "humanoid", "quadruped": "animal"}
"""What a catalogue that knows categories calls them; walking machines and monsters have bones of people, too."""

LEFT_OUT = ("ray_greenman", "mtg_character", "q_easy_enemies_Frog")
"""Bodies that are no person and no quadruped, though their bones are called so: a round one, a box, a sitting frog."""


@dataclass(frozen=True)
class Subject:
    """An asset with known joints: bones by the joints that begin there, and the mesh, which looks along -y."""

    asset: Asset
    mesh: RiggedMesh
    bones: dict[str, int]

    @property
    def free(self) -> bool:
        """Whether what is learned from it may be passed on."""
        return self.asset.license in FREE_LICENCES


def subjects(folder: Path, kind: str) -> list[Subject]:
    """The assets of a folder whose bones' names tell the joints of a kind of body.

    Raises:
        InputError: there is no such folder, or no such asset in it.
    """
    found = []
    kinds = _categories(folder)
    for asset in list_assets(folder, any_licence=True):
        if asset.name in LEFT_OUT or not asset.path.is_file():
            continue
        if kinds.get(asset.name, CATEGORY[kind]) != CATEGORY[kind]:
            continue
        mesh = read_rigged_mesh(asset.path)
        if kind == "human":
            if quadruped_bones(mesh.skeleton):
                continue
            bones = human_bones(mesh.skeleton, mesh.used)
            sides = {name for name in bones if name.startswith(("elbow", "knee"))}
            if len(bones) < FEWEST or len(sides) < 4:
                continue
        else:
            bones = quadruped_bones(mesh.skeleton)
            if len(bones) < FEWEST:
                continue
        mesh, bones = feet_on_legs(mesh, bones)
        turned = turned_to_front(mesh, bones)
        if turned is not None:
            found.append(Subject(asset, turned, bones))
    if not found:
        raise InputError(f"'{folder}' has no rigged {kind} whose bones' names are known; name a folder with some.")
    return found


def _categories(folder: Path) -> dict[str, str]:
    """The category of each asset, where the folder's catalogue has such."""
    catalog = folder / "catalog.json"
    if not catalog.is_file():
        return {}
    entries = json.loads(catalog.read_text(encoding="utf-8"))["assets"]  # list_assets has found it sound
    return {str(entry["name"]): str(entry["category"]) for entry in entries if "category" in entry}


def examples_of(
    found: list[Subject], kind: str, share: int, told: Callable[[str], None] = lambda _: None
) -> list[tuple[Subject, Example]]:
    """Each free subject in other proportions and poses, about `share` examples of each family, 4 to 40 of each."""
    names = HUMAN if kind == "human" else QUADRUPED
    change = change_person if kind == "human" else change_quadruped
    sizes = Counter(subject.asset.family for subject in found)
    out = []
    for number, subject in enumerate(found):
        rng = np.random.default_rng(number)
        if not subject.free:
            continue
        count = int(np.clip(share / sizes[subject.asset.family], 4, 40))
        for _ in range(count):
            mesh = change(subject.mesh, subject.bones, rng)
            out.append((subject, make_example(mesh, subject.bones, names, rng, float(rng.normal(0, 0.1)))))
        out.append((subject, make_example(subject.mesh, subject.bones, names, rng)))
        told(f"{subject.asset.name}: {count + 1} examples")
    return out
