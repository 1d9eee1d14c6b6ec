# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tests/window`: install the zip in real Blenders, play tests/window/session.py in their windows, judge it.

The Blender is $BLENDER, else both that Debian has (4.3 and 5.2), made once in build/blender-SUITE (needs root); after
these the 3D view of bpy 5.3 is drawn off screen. The pictures go to out/window-SUITE; with --pictures the best of
them, from the last Blender, also to docs/images.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from blenders import SUITES, Blender, find_blenders
from installing import check_repository
from judging import (
    CLICK_MOVED,
    CLICKED,
    FREED,
    FREED_MOVED,
    PAINT_MOVED,
    PAINTED,
    Check,
    judge,
    judge_weights,
)
from offscreen import VERSION, check_viewport
from splat_pictures import judge_splats
from version_venv import Missing, make

ROOT = Path(__file__).resolve().parents[2]
PICTURES = {"01_panel": "panel", "03_progress_60": "progress", "05_posed": "posed"}
SCREEN = "-screen 0 1600x900x24"
LONGEST = 3600
"""Seconds after which a session is given up, on however busy a machine."""


def main() -> int:
    """Everything from the zip to the verdict; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make test-window", description=__doc__.splitlines()[0])
    parser.add_argument("--suite", action="append", choices=SUITES, help="only this Debian (default: both)")
    parser.add_argument("--demo", type=Path, default=ROOT / "out" / "demo", help="where `make demo` wrote")
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="pictures and results go below (default: out)")
    parser.add_argument("--preset", default="standard", help="preset of the job (default: standard)")
    parser.add_argument("--background", action="store_true", help="only what needs no window")
    parser.add_argument("--viewport", action="store_true", help=f"only the 3D view of bpy {VERSION}")
    parser.add_argument("--splats", action="store_true", help="only the drawing of splats in windows")
    parser.add_argument("--strokes", action="store_true", help="only Blender's weight tools by mouse")
    parser.add_argument("--hands", action="store_true", help="only our own tools by mouse")
    parser.add_argument("--chapter", action="append", default=[], help="with --hands: only this of its chapters")
    parser.add_argument("--helmet", action="store_true", help="only the helmet of a real capture, which is separated")
    parser.add_argument("--pictures", action="store_true", help="renew docs/images")
    options = parser.parse_args()
    splats, rig = sample(options.demo.absolute(), rigged=not options.splats)
    part = options.background or options.splats or options.strokes or options.hands or options.helmet
    blenders = [] if options.viewport else find_blenders(options.suite)
    verdicts: dict[str, list[Check] | str] = {}
    for blender in blenders:
        out = fresh(options.out.absolute() / f"window-{blender.name}")
        print(f"\nBlender of {blender.name}", flush=True)
        verdicts[f"Blender of {blender.name}"] = play(blender, out, splats, rig, options)
    if not (part or options.suite or os.environ.get("BLENDER")):
        verdicts[f"3D view of bpy {VERSION}"] = check_viewport(fresh(options.out.absolute() / "viewport"), splats)
    print()
    for name, checks in verdicts.items():
        if isinstance(checks, str):
            print(f"{name}: {checks}")
        else:
            failed = [what for what, good, _ in checks if not good]
            print("\n  ".join([f"{name}: {len(checks) - len(failed)} passed, {len(failed)} failed", *failed]))
    good = all(all(check[1] for check in checks) for checks in verdicts.values() if not isinstance(checks, str))
    return 0 if good else 1


def play(blender: Blender, out: Path, splats: Path, rig: Path, options: argparse.Namespace) -> list[Check]:
    """Install the extension in a Blender, try it without a window and in one; returns all that was checked."""
    archive = build_zip(out)
    user = out / "user"
    user.mkdir()
    environment = {
        "BLENDER_USER_RESOURCES": str(user),
        # This interpreter runs the worker: it has torch.
        "GSKIN_PYTHON": sys.executable,
        "LIBGL_ALWAYS_SOFTWARE": "1",
    }
    install = [blender.program, "--command", "extension", "install-file", "-r", "user_default", "-e", str(archive)]
    if blender.run(install, environment, LONGEST) != 0:
        return [("Blender installs the extension", False, "its words are above")]
    if options.splats:
        return play_splats(blender, out / "splats", splats, environment)
    if options.strokes:
        return play_strokes(blender, out / "strokes", splats, rig, environment)
    if options.hands:
        return play_hands(blender, out / "hands", splats, rig, environment, options.chapter)
    if options.helmet:
        return play_helmet(blender, out / "helmet", environment)
    plain = [blender.program, "-b", "--python-exit-code", "1", "--python", str(ROOT / "tests/window/background.py")]
    if blender.run([*plain, "--", "--out", str(out), "--splats", str(splats)], environment, LONGEST) != 0:
        return [("the extension works without a window", False, "Blender's words are above")]
    first: list[Check] = [("the extension works without a window", True, ""), check_repository(blender, out, LONGEST)]
    loose = [*plain[:-1], str(ROOT / "tests/window/loose_actions.py"), "--", "--out", str(out / "loose")]
    owners = blender.run(loose, environment, LONGEST)
    first.append(("loose actions of other rigs stay out of a .glb", owners == 0, "Blender's words are above"))
    if options.background:
        return first
    session = [
        *("xvfb-run", "-a", "-s", SCREEN, blender.program),
        *("--window-geometry", "0", "0", "1600", "900", "--python", str(ROOT / "tests/window/session.py"), "--"),
        *("--out", str(out), "--splats", str(splats), "--rig", str(rig), "--preset", options.preset),
    ]
    # After Blender is gone a worker may live for a second; then none may be left.
    after = f'"$@"; code=$?; sleep 1.5; pgrep -af "core/worker/process.py.*" > {out}/left.txt; exit $code'
    code = blender.run(["sh", "-c", after, "sh", *session], environment, LONGEST)
    played = judge(out)
    if played is None:
        return [*first, ("the session comes to its end", False, f"Blender ended with {code}; its words are above")]
    checks = [*first, *played]
    if code != 0:
        checks.append(("Blender ends well", False, f"exit code {code}"))
    checks += play_splats(blender, out / "splats", splats, environment)
    checks += play_strokes(blender, out / "strokes", splats, rig, environment)
    checks += play_hands(blender, out / "hands", splats, rig, environment)
    if options.pictures and all(good for _, good, _ in checks):
        images = ROOT / "docs" / "images"
        images.mkdir(parents=True, exist_ok=True)
        for shot, name in PICTURES.items():
            shutil.copyfile(out / f"{shot}.png", images / f"{name}.png")
    return checks


def play_splats(blender: Blender, out: Path, splats: Path, environment: dict[str, str]) -> list[Check]:
    """True splats in a window: the sample's, and where it is there a real capture's; pictures below `out`."""
    words = ["--out", str(fresh(out)), "--splats", str(splats)]
    folder = Path(os.environ.get("GSKIN_ASSETS", ROOT.parent / "shared" / "assets")).absolute() / "splats"
    capture, rig = folder / "pc_biker.ply", folder / "pc_biker_rig.glb"
    if capture.is_file() and rig.is_file():
        words += ["--capture", str(capture), "--capture-rig", str(rig)]
    session = [
        *("xvfb-run", "-a", "-s", SCREEN, blender.program),
        *("--window-geometry", "0", "0", "1600", "900", "--python", str(ROOT / "tests/window/splats.py"), "--"),
    ]
    code = blender.run([*session, *words], environment, LONGEST, [folder])
    checks = judge_splats(out)
    if checks is None:
        return [("the splats' session comes to its end", False, f"Blender ended with {code}; its words are above")]
    return checks if code == 0 else [*checks, ("Blender ends well after drawing splats", False, f"exit code {code}")]


def play_strokes(blender: Blender, out: Path, splats: Path, rig: Path, environment: dict[str, str]) -> list[Check]:
    """Blender's weight tools on the sample, by mouse; pictures below `out`."""
    words = ["--splats", str(splats), "--rig", str(rig)]
    return play_weights(blender, out, "strokes.py", words, PAINTED, PAINT_MOVED, environment)


def play_hands(
    blender: Blender,
    out: Path,
    splats: Path,
    rig: Path,
    environment: dict[str, str],
    chapters: Sequence[str] = (),
) -> list[Check]:
    """Our own tools on the sample, by clicks; pictures below `out`."""
    words = ["--splats", str(splats), "--rig", str(rig), *(word for name in chapters for word in ("--only", name))]
    shown = () if chapters else CLICKED
    return play_weights(blender, out, "hands.py", words, shown, CLICK_MOVED, environment)


def play_helmet(blender: Blender, out: Path, environment: dict[str, str]) -> list[Check]:
    """The capture's helmet, freed from the thigh; pictures below `out`."""
    folder = Path(os.environ.get("GSKIN_ASSETS", ROOT.parent / "shared" / "assets")).absolute() / "splats"
    if not folder.is_dir():
        return [("the capture is there", False, str(folder))]
    words = ["--splats", str(folder / "pc_biker.ply"), "--rig", str(folder / "pc_biker_rig.glb"), "--again"]
    return play_weights(blender, out, "helmet.py", words, FREED, FREED_MOVED, environment, folder)


def play_weights(
    blender: Blender,
    out: Path,
    script: str,
    words: list[str],
    shown: Sequence[str],
    differing: Sequence[tuple[str, str]],
    environment: dict[str, str],
    *folders: Path,
) -> list[Check]:
    """Play a script of weights by mouse, and judge it; see `judge_weights`."""
    session = [
        *("xvfb-run", "-a", "-s", SCREEN, blender.program),
        *("--window-geometry", "0", "0", "1600", "900", "--python", str(ROOT / "tests/window" / script), "--"),
        *("--out", str(fresh(out)), *words),
    ]
    code = blender.run(session, environment, LONGEST, list(folders))
    checks = judge_weights(out, shown, differing)
    if checks is None:
        return [(f"{script} comes to its end", False, f"Blender ended with {code}; its words are above")]
    return checks if code == 0 else [*checks, (f"Blender ends well after {script}", False, f"exit code {code}")]


def build_zip(out: Path) -> Path:
    """The archive as `make zip` makes it."""
    subprocess.check_call([sys.executable, str(ROOT / "tools/build_zip.py"), "--out", str(out)], stdout=sys.stderr)
    return next(out.glob("gskin_addon-*.zip"))


def sample(demo: Path, *, rigged: bool = True) -> tuple[Path, Path]:
    """The demo's character and its rig, which is made readable if `rigged`; modelled where `make demo` has not run."""
    splats, rig = demo / "brindle.ply", demo / "brindle_rig.blend"
    if not (splats.is_file() and rig.is_file()):
        subprocess.check_call([sys.executable, "-m", "demo", "--out", str(demo), "--character-only"], cwd=ROOT)
    return splats, readable(rig) if rigged else rig


def readable(rig: Path) -> Path:
    """The rig as Blender 4.3 reads it too: 4.5 reads what 5.0 writes, and writes what 4.3 reads."""
    old = rig.with_name(f"{rig.stem}_old.blend")
    if not old.is_file() or old.stat().st_mtime < rig.stat().st_mtime:
        code = "import bpy, sys; bpy.ops.wm.open_mainfile(filepath=sys.argv[1])"
        code += "; bpy.ops.wm.save_as_mainfile(filepath=sys.argv[2])"
        try:
            subprocess.check_call([make("4.5"), "-c", code, rig, old], stdout=sys.stderr)
        except Missing as problem:
            raise SystemExit(f"The sample's rig cannot be saved for Blender 4.3: {problem}") from problem
    return old


def fresh(folder: Path) -> Path:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


if __name__ == "__main__":
    sys.exit(main())
