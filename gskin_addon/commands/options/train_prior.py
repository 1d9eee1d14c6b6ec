# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin train-prior`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .numbers import positive, seed
from .shared import common, progress

STEPS = 500
CREATURES = 480
NETWORKS = 3


def add(commands: Any) -> None:
    """Add `gskin train-prior` to the commands."""
    train = commands.add_parser(
        "train-prior",
        help="train the learned initial weights on rigged assets",
        description="Train the network behind --init learned on rigged assets (docs/training.md). Stopped, the same "
        "command goes on where it was.",
        allow_abbrev=False,
    )
    train.set_defaults(command="train_prior")
    train.add_argument("--assets", type=Path, required=True, metavar="FOLDER", help="holds catalog.json and npz/")
    train.add_argument("--out", type=Path, required=True, metavar="MODEL.safetensors")
    train.add_argument(
        "--leave-out", action="append", default=[], metavar="FAMILY", help="a family not to learn from; repeatable"
    )
    train.add_argument("--fold", default="", metavar="NAME", help="leave out the families of a fold of the model card")
    train.add_argument("--steps", type=positive, default=STEPS, metavar="N", help="(default: %(default)s)")
    train.add_argument("--creatures", type=int, default=CREATURES, metavar="N",
                       help="made-up bodies (default: %(default)s)")  # fmt: skip
    train.add_argument("--networks", type=positive, default=NETWORKS, metavar="N",
                       help="trained in turn, their answers are averaged (default: %(default)s)")  # fmt: skip
    train.add_argument("--seed", type=seed, default=0, metavar="N", help="same seed, same model (default: 0)")
    train.add_argument("--cache", type=Path, metavar="D", help="where described bodies are kept, for further runs")
    train.add_argument("--threads", type=positive, default=2, metavar="N", help="(default: %(default)s)")
    progress(train)
    common(train)
