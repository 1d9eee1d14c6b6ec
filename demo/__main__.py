# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m demo`: make the sample character, rig it with the command line, and show what came out."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from gskin_addon.commands.console import quiet_stdout
from gskin_addon.core.files import write_text
from gskin_addon.core.rig.lbs import sparsify
from gskin_addon.core.rig.weights_file import read_weights_file
from gskin_addon.core.splats.ply import read_ply, write_ply

SPLATS = 40_000
FRAMES = 48
POSE_VIEWS = (25.0, -35.0, 50.0, 20.0)


def main() -> int:
    """Run the demo; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m demo", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for the results")
    parser.add_argument("--splats", type=int, default=SPLATS, help="number of splats (default: %(default)s)")
    parser.add_argument("--preset", default="standard", help="preset of the job (default: %(default)s)")
    parser.add_argument("--character-only", action="store_true", help="make the splats and the rig, no more")
    options = parser.parse_args()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()

    print_message("modelling Brindle: 29 bones, horns, cape, kilt and tail")
    from gskin_addon.scene.armature import read_skeleton
    from gskin_addon.scene.rig_files import save_blend

    from . import blender_tools, character, pictures, report
    from .skeleton import POSES, wave_at

    with quiet_stdout():
        model = character.build()
    cloud, truth = character.to_splats(model, options.splats, seed=0)
    blender_tools.add_action(model.rig, "Wave", FRAMES, wave_at)
    skeleton = read_skeleton(model.rig)
    truth = truth[:, [model.bones.index(name) for name in skeleton.names]].astype(np.float32)
    ply, rig, rigged = out / "brindle.ply", out / "brindle_rig.blend", out / "brindle.blend"
    weights = out / "weights.npz"
    write_ply(ply, cloud)
    with quiet_stdout():
        save_blend(rig)
    if options.character_only:
        return 0

    print_message(f"{cloud.count:,} splats in {ply}; the job sees these and {rig}, nothing else")
    gskin("rig", ply, "--armature", rig, "--out", rigged, "--weights", weights, "--preset", options.preset)
    gskin("pose", rigged, "--out", out / "brindle.glb")

    print_message("comparing with the true weights")
    cloud = read_ply(ply).cloud
    learned = read_weights_file(weights).weights
    start = sparsify(report.initial_of(cloud, skeleton), 4)
    scores = report.score(cloud, skeleton, truth, {"initial": start, "learned": learned})
    summary = report.table(scores)
    write_text(out / "report.txt", summary + "\n")

    print_message("drawing")
    compared = {"initial weights": start, "learned weights": learned, "truth": truth}
    poses = {name: report.transforms_of(skeleton, turns) for name, turns in POSES.items()}
    sheet = pictures.contact_sheet(cloud, poses, compared, POSE_VIEWS, cell=360)
    pictures.save_png(sheet, out / "contact_sheet.png")
    pictures.save_png(pictures.weight_sheet(cloud, compared, cell=400), out / "weights.png")
    frames = pictures.animation(
        cloud, learned, lambda phase: report.transforms_of(skeleton, wave_at(phase)), FRAMES, 320
    )
    pictures.save_gif(frames, out / "brindle.gif", seconds=4.0)

    print(f"\n{summary}\n")
    for name in (
        "brindle.blend",
        "brindle.glb",
        "contact_sheet.png",
        "weights.png",
        "brindle.gif",
        "weights.npz",
    ):
        print(f"{(out / name).stat().st_size / 1e6:8.1f} MB  {out / name}")
    print_message(f"done in {time.monotonic() - started:.0f} s")
    return 0


def gskin(*arguments: object) -> None:
    """The command line, as a person would type it."""
    words = [str(argument) for argument in arguments]
    print_message("gskin " + " ".join(words))
    code = subprocess.call([sys.executable, "-m", "gskin_addon.cli", *words])
    if code != 0:
        raise SystemExit(code)


def print_message(message: str) -> None:
    """One line for the person who waits."""
    print(f"demo: {message}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
