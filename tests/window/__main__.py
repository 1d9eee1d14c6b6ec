# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tests/window`: install the zip in a real Blender, play tests/window/session.py in its window, judge it.

The Blender is $BLENDER, or one that Debian has, made once in build/blender-SUITE (needs root). The pictures go to
--out; with --pictures the best of them also to docs/images.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEBIAN = ROOT / "tools" / "debian_blender.sh"
PICTURES = {"01_panel": "panel", "03_progress_60": "progress", "05_posed": "posed"}
SCREEN = "-screen 0 1600x900x24"


class Blender:
    """A Blender program: on this machine, or in a Debian of its own."""

    def __init__(self, program: str, debian: Path | None) -> None:
        self.program, self.debian = program, debian

    def run(self, words: list[str], environment: dict[str, str], timeout: float) -> int:
        """Run a command where Blender is; returns its exit code."""
        if self.debian is None:
            return subprocess.call(words, env={**os.environ, **environment}, timeout=timeout, cwd=ROOT)
        command = [str(DEBIAN), "run", str(self.debian)]
        for path in self._shown():
            command += ["-b", str(path)]
        command += ["--", *(f"{name}={value}" for name, value in environment.items()), *words]
        return subprocess.call(command, timeout=timeout, cwd=ROOT)

    def _shown(self) -> list[Path]:
        # The folder of the project at its own place, and the Python that its environment is built on.
        base = Path(sys.base_prefix)
        return [ROOT] if base == Path("/usr") else [ROOT, base]


def main() -> int:
    """Everything from the zip to the verdict; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make test-window", description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="sid", help="Debian's sid has Blender 5.2, trixie 4.3 (default: sid)")
    parser.add_argument("--demo", type=Path, default=ROOT / "out" / "demo", help="where `make demo` wrote")
    parser.add_argument("--out", type=Path, help="folder for pictures and result (default: out/window-SUITE)")
    parser.add_argument("--preset", default="standard", help="preset of the job (default: standard)")
    parser.add_argument("--background", action="store_true", help="only what needs no window")
    parser.add_argument("--pictures", action="store_true", help="renew docs/images")
    options = parser.parse_args()
    out = (options.out or ROOT / "out" / f"window-{options.suite}").absolute()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)

    blender = find_blender(options.suite)
    archive = build_zip(out)
    splats, rig = sample(options.demo.absolute())
    user = out / "user"
    user.mkdir()
    environment = {
        "BLENDER_USER_RESOURCES": str(user),
        "GSKIN_PYTHON": str(worker_python()),
        "LIBGL_ALWAYS_SOFTWARE": "1",
    }
    install = [blender.program, "--command", "extension", "install-file", "-r", "user_default", "-e", str(archive)]
    if blender.run(install, environment, 120) != 0:
        return say("Blender did not install the extension; its words are above.", 1)
    plain = [blender.program, "-b", "--python-exit-code", "1", "--python", str(ROOT / "tests/window/background.py")]
    if blender.run([*plain, "--", "--out", str(out), "--splats", str(splats)], environment, 300) != 0:
        return say("The extension fails without a window; Blender's words are above.", 1)
    if options.background:
        return 0
    session = [
        *("xvfb-run", "-a", "-s", SCREEN, blender.program),
        *("--window-geometry", "0", "0", "1600", "900", "--python", str(ROOT / "tests/window/session.py"), "--"),
        *("--out", str(out), "--splats", str(splats), "--rig", str(rig), "--preset", options.preset),
    ]
    # After Blender is gone a worker may live for a second; then none may be left.
    after = f'"$@"; code=$?; sleep 1.5; pgrep -af "core/worker/process.py.*" > {out}/left.txt; exit $code'
    code = blender.run(["sh", "-c", after, "sh", *session], environment, 1500)
    return judge(out, code, options.pictures)


def find_blender(suite: str) -> Blender:
    """$BLENDER, or Debian's."""
    named = os.environ.get("BLENDER", "")
    if named:
        for program in (named, "xvfb-run", "xdotool", "import"):
            if shutil.which(program) is None:
                raise SystemExit(f"'{program}' cannot be run; BLENDER= needs xvfb, xdotool and imagemagick here.")
        return Blender(named, None)
    debian = ROOT / "build" / f"blender-{suite}"
    if subprocess.call([str(DEBIAN), "setup", suite, str(debian)]) != 0:
        raise SystemExit(2)
    return Blender("blender", debian)


def build_zip(out: Path) -> Path:
    """The archive as `make zip` makes it."""
    subprocess.check_call([sys.executable, str(ROOT / "tools/build_zip.py"), "--out", str(out)], stdout=sys.stderr)
    return next(out.glob("gskin_addon-*.zip"))


def sample(demo: Path) -> tuple[Path, Path]:
    """The demo's character; modelled now where `make demo` has not run."""
    splats, rig = demo / "brindle.ply", demo / "brindle_rig.blend"
    if not (splats.is_file() and rig.is_file()):
        subprocess.check_call([sys.executable, "-m", "demo", "--out", str(demo), "--character-only"], cwd=ROOT)
    return splats, rig


def worker_python() -> Path:
    """This interpreter runs the worker: it has torch."""
    return Path(sys.executable)


def judge(out: Path, code: int, renew: bool) -> int:
    """Print what was checked and measured; returns the exit code."""
    path = out / "result.json"
    if not path.is_file():
        return say(f"Blender ended (exit code {code}) before the session did; its words are above.", 1)
    result = json.loads(path.read_text())
    left = (out / "left.txt").read_text().split("\n")
    left = [line for line in left if line and "pgrep" not in line and "sh -c" not in line]
    result["checks"].append(["closing Blender stops the worker", not left, "; ".join(left)])
    for what, good, seen in result["checks"]:
        print(f"{'ok  ' if good else 'FAIL'}  {what}" + (f": {seen}" if seen else ""))
    for name, value in result["numbers"].items():
        print(f"{name:>28}  {value:.4g}")
    failed = sum(not good for _, good, _ in result["checks"])
    if renew and not failed:
        images = ROOT / "docs" / "images"
        images.mkdir(parents=True, exist_ok=True)
        for shot, name in PICTURES.items():
            shutil.copyfile(out / f"{shot}.png", images / f"{name}.png")
    print(f"{len(result['checks']) - failed} passed, {failed} failed")
    return 1 if failed or code != 0 else 0


def say(sentence: str, code: int) -> int:
    """One sentence for the person, and the exit code."""
    print(sentence, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
