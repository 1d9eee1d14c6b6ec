# SPDX-License-Identifier: GPL-3.0-or-later
"""The verdict on a played session: what Blender itself checked, and what its pictures show."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from looks import changed, look, read

Check = tuple[str, bool, str]

EMPTY = "00_empty"
SPLATS = ("01_panel", "03_progress_60", "04_done", "05_posed", "06_posed_clean", "07_posed_material", "08_reloaded")
"""Pictures that must show the character."""
MOVED = (("04_done", "05_posed"), ("06_posed_clean", "08_reloaded"))
"""Pairs between which the character has moved."""
PAINTED = ("k00_posed", "k01_weight_paint", "k02_painted", "k05_back", "k06_edit")
PAINT_MOVED = (("k00_posed", "k01_weight_paint"), ("k01_weight_paint", "k02_painted"))
CLICKED = ("w01_fit_human", "w05_imported", "w13_tried", "w20_captured", "w21_bones", "w25_moves_with", "w31_by_bone",
           "w42_mirrored", "w51_separated", "w61_transferred")  # fmt: skip
CLICK_MOVED = (("w20_captured", "w21_bones"), ("w20_captured", "w22_confidence"), ("w20_captured", "w23_weights"),
               ("w20_captured", "w25_moves_with"), ("w10_skinned", "w11_try"), ("w10_skinned", "w13_tried"),
               ("w60_lost", "w61_transferred"))  # fmt: skip
FREED = ("h00_before", "h03_lasso", "h05_after")
FREED_MOVED = (("h00_before", "h05_after"),)
"""Pictures of strokes.py, hands.py and helmet.py that must show the figure, and pairs between which something has
changed."""
FILLED, COLOURS, MOVED_SHARE = 0.1, 10_000, 0.03
"""Least share of a view that is not background and least number of its colours; least share that a pose changes."""


def check_pictures(folder: Path, views: Mapping[str, tuple[int, int, int, int]]) -> list[Check]:
    """Checks (what, good, seen) of the pictures in a folder; views: where in each the 3D view is."""
    checks: list[Check] = []
    for name in (EMPTY, *SPLATS):
        if name not in views:
            checks.append((f"picture {name} was taken", False, ""))
            continue
        whole, view = look(read(folder / f"{name}.png")), look(read(folder / f"{name}.png", views[name]))
        checks.append((f"picture {name} shows a window", whole.filled > 0.1 and whole.colours > 100, str(whole)))
        if name == EMPTY:
            # The bars mean something only where a view without splats misses them.
            checks.append((f"picture {name} shows no splats", view.colours < COLOURS / 2, str(view)))
        else:
            good = view.filled > FILLED and view.colours > COLOURS
            checks.append((f"picture {name} shows the splats", good, str(view)))
    for before, after in MOVED:
        if before in views and after in views:
            share = changed(*(read(folder / f"{name}.png", views[before]) for name in (before, after)))
            checks.append((f"between {before} and {after} the splats move", share > MOVED_SHARE, f"{share:.0%}"))
    return checks


def judge(out: Path) -> list[Check] | None:
    """Print what was checked and measured; returns the checks, None where the session did not come to its end."""
    path = out / "result.json"
    if not path.is_file():
        return None
    result = json.loads(path.read_text())
    left = (out / "left.txt").read_text().split("\n")
    left = [line for line in left if line and "pgrep" not in line and "sh -c" not in line]
    checks = [*map(tuple, result["checks"]), ("closing Blender stops the worker", not left, "; ".join(left))]
    checks += check_pictures(out, result["views"])
    print_checks(checks)
    for name, value in result["numbers"].items():
        print(f"{name:>28}  {value:.4g}")
    return checks


def judge_weights(out: Path, shown: Sequence[str], differing: Sequence[tuple[str, str]]) -> list[Check] | None:
    """Print what was checked and measured of strokes.py, hands.py or helmet.py; None where it did not come to its end.

    shown: pictures that must show the figure; differing: pairs of them that must not be alike.
    """
    path = out / "result.json"
    if not path.is_file():
        return None
    result = json.loads(path.read_text())
    checks: list[Check] = [*map(tuple, result["checks"])]
    views = result["views"]
    for name in shown:
        good = name in views
        seen = look(read(out / f"{name}.png", views[name])) if good else None
        checks.append((f"picture {name} shows a figure", good and seen.filled > 0.03 and seen.colours > 500, str(seen)))
    for before, after in differing:
        if before in views and after in views:
            share = changed(*(read(out / f"{name}.png", views[before]) for name in (before, after)))
            checks.append((f"{before} and {after} differ", share > 0.001, f"{share:.2%}"))
    print_checks(checks)
    for name, value in result["numbers"].items():
        print(f"{name:>28}  {value:.4g}")
    return checks


def print_checks(checks: list[Check]) -> None:
    """One line each."""
    for what, good, seen in checks:
        print(f"{'ok  ' if good else 'FAIL'}  {what}" + (f": {seen}" if seen else ""))
