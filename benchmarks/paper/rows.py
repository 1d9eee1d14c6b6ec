# SPDX-License-Identifier: GPL-3.0-or-later
"""Which method in which case makes which row of which of the paper's tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.quality.cases import ANCHORED, ISOTROPIC
from benchmarks.quality.perturb import DISTURBANCE_TITLES
from benchmarks.quality.results import OWN


@dataclass(frozen=True)
class Row:
    """One line: its title, the method and the case (a key of `quality.cases.CASES`); paper: PSNR, SSIM and LPIPS that
    the paper has for it, on other assets."""

    title: str
    method: str
    case: str = OWN
    paper: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Table:
    """A table by its key."""

    key: str
    title: str
    rows: tuple[Row, ...]


THIRD_PARTY: dict[str, tuple[str, tuple[float, float, float] | None]] = {
    "unirig": ("UniRig", (25.61, 0.959, 0.0478)),
    "puppeteer": ("Puppeteer", (26.19, 0.963, 0.0475)),
    "mia": ("MIA", None),
}
"""Methods of the paper that do not run here, by the name that `--method-weights` knows them by in small letters: title,
and the paper's PSNR, SSIM, LPIPS in Table II."""


def tables(guidance: str, preset: str, given: Sequence[str]) -> list[Table]:
    """All tables. guidance, preset: of our jobs, which start from the paper's initial weights; given: methods of
    `methods.from_file`."""
    ours = f"job:init=visibility,guidance={guidance},preset={preset}"
    names = {name.removeprefix("file:").lower(): name for name in given}
    names |= {key: f"file:{key}" for key in THIRD_PARTY if key not in names}
    others, anchored, balls = [], [], []
    for key, name in names.items():
        title, paper = THIRD_PARTY.get(key, (name.removeprefix("file:"), None))
        others.append(Row(title, name))
        anchored.append(Row(title, name, ANCHORED, paper))
        balls.append(Row(title, name, ISOTROPIC))
    skeletons = [case for case in DISTURBANCE_TITLES if case != OWN]
    return [
        Table("vanilla", "Table II with vanilla splats", (
            Row("initial weights (Eq. 6-7)", "initial"),
            Row("BBW (libigl)", "bbw"),
            Row("bone heat, true mesh", "heat_mesh"),
            Row("bone heat, mesh of the splats", "heat_proxy"),
            *others,
            Row("ours", ours),
            Row("ours, default job", "ours:default"),
        )),
        Table("anchored", "Table II with mesh-anchored splats", (
            Row("initial weights (Eq. 6-7)", "initial", ANCHORED),
            Row("BBW (libigl)", "bbw", ANCHORED, (22.11, 0.935, 0.0580)),
            Row("bone heat, true mesh", "heat_mesh", ANCHORED),
            *anchored,
            Row("ours, learned on the mesh", f"{ours},mesh=1", ANCHORED, (26.37, 0.964, 0.0447)),
        )),
        Table("isotropic", "Isotropic splats", (
            Row("initial weights (Eq. 6-7)", "initial", ISOTROPIC),
            Row("BBW (libigl)", "bbw", ISOTROPIC),
            *balls,
            Row("ours", ours, ISOTROPIC),
        )),
        Table("ablation", "Losses and views", (
            Row("initial weights", "initial", paper=(23.83, 0.945, 0.0557)),
            Row("without ARAP", f"{ours},loss.arap=0", paper=(25.40, 0.957, 0.0513)),
            Row("without coupling", f"{ours},loss.coupling=0", paper=(24.76, 0.954, 0.0481)),
            Row("1 view", f"{ours},views=1", paper=(25.95, 0.961, 0.0464)),
            Row("2 views", f"{ours},views=2", paper=(26.07, 0.962, 0.0456)),
            Row("6 views", f"{ours},views=6", paper=(26.20, 0.963, 0.0448)),
            Row("ours (4 views)", ours, paper=(26.37, 0.964, 0.0447)),
        )),
        Table("skeletons", "Imperfect skeletons", tuple(
            Row(f"{title}: {DISTURBANCE_TITLES[case]}", method, case)
            for case in skeletons
            for title, method in (("initial weights", "initial"), ("ours", ours))
        )),
    ]  # fmt: skip
