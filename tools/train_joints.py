# SPDX-License-Identifier: GPL-3.0-or-later
"""Remake the networks of Fit Human and Fit Quadruped from rigged assets.

    python tools/train_joints.py ASSETS human gskin_addon/core/skeleton/joints_human.npz [--share 110] [--steps 1500]
    python tools/train_joints.py ASSETS quadruped gskin_addon/core/skeleton/joints_quadruped.npz --share 200

Takes about ten minutes of a 2-core CPU; needs torch. Only assets are used whose licence lets pass on what was learned.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gskin_addon.core.errors import GSkinError
from gskin_addon.core.files import write_atomically
from gskin_addon.core.skeleton.joints import HUMAN, QUADRUPED
from gskin_addon.core.training.skeleton.collect import examples_of, subjects
from gskin_addon.core.training.skeleton.train import STEPS, train


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", type=Path)
    parser.add_argument("kind", choices=("human", "quadruped"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--share", type=int, default=110, help="examples of each family (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=STEPS, help="(default: %(default)s)")
    options = parser.parse_args()
    try:
        found = examples_of(subjects(options.assets, options.kind), options.kind, options.share, told=print)
        names = HUMAN if options.kind == "human" else QUADRUPED
        families = [subject.asset.family for subject, _ in found]
        learned = train([example for _, example in found], families, names, steps=options.steps, told=print)
        write_atomically(options.out, lambda file: np.savez_compressed(file, **learned))
    except GSkinError as error:
        print(error.plain, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
