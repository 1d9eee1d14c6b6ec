# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin train-guidance`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .numbers import positive, seed, size, unit
from .shared import Parser, common, consent, progress


def add(commands: Any) -> None:
    """Add `gskin train-guidance` to the commands."""
    train = commands.add_parser(
        "train-guidance",
        help="import rigged models, make image pairs of them, and fine-tune a guidance model on these",
        description="Fine-tune a guidance model as the paper does, step by step; see docs/guidance.md.",
        allow_abbrev=False,
    )
    steps = train.add_subparsers(dest="step", required=True, metavar="STEP", parser_class=Parser)
    models = _import(steps)
    pairs = steps.add_parser(
        "pairs",
        help="rigged assets to pairs of a rest image and a posed image",
        description="Pose rigged assets at random, see them from four views, and keep the image pairs. The same "
        "command goes on where a stopped one was.",
        allow_abbrev=False,
    )
    pairs.set_defaults(needs=("numba", "scipy", "PIL"), extra="gskin_addon[worker]")
    pairs.add_argument("assets", type=Path, metavar="ASSETS", help="folder of rigged .npz assets")
    pairs.add_argument("--out", type=Path, required=True, metavar="PAIRS", help="folder to write")
    pairs.add_argument(
        "--poses", type=positive, default=71, metavar="N", help="per asset and view, of four (default: %(default)s)"
    )
    pairs.add_argument("--size", type=size, default=512, metavar="PIXELS", help="(default: %(default)s)")
    pairs.add_argument("--splats", type=positive, default=30_000, metavar="N", help="per asset (default: %(default)s)")
    pairs.add_argument(
        "--validation", type=unit, default=0.1, metavar="SHARE", help="of the assets, whole families (default: 0.1)"
    )
    pairs.add_argument(
        "--leave-out", action="append", default=[], metavar="FAMILY", help="keep a family for tests; repeatable"
    )
    pairs.add_argument("--per-family", type=positive, default=0, metavar="N", help="most assets of a family")
    pairs.add_argument(
        "--any-licence", action="store_true", help="also assets whose licence binds what is learned from them"
    )
    pairs.add_argument(
        "--true-masks",
        type=unit,
        default=0.1,
        metavar="SHARE",
        help="of the pairs, whose masks also cover what the true pose changes (default: 0.1)",
    )
    pairs.add_argument("--seed", type=seed, default=0, metavar="N", help="same seed, same pairs (default: 0)")
    tune = steps.add_parser(
        "tune",
        help="fine-tune LightningDrag or FLUX.2 [klein] on image pairs",
        description="Fine-tune LightningDrag weights, or train a LoRA of FLUX.2 [klein], on image pairs. The same "
        "command goes on where a stopped one was.",
        allow_abbrev=False,
    )
    tune.set_defaults(needs=("torch", "diffusers", "accelerate"), extra="gskin_addon[worker,diffusion]")
    tune.add_argument("pairs", type=Path, metavar="PAIRS", help="what `train-guidance pairs` wrote")
    tune.add_argument("--out", type=Path, required=True, metavar="MODEL", help="folder to write")
    tune.add_argument(
        "--model",
        choices=("lightning_drag", "flux2"),
        default="lightning_drag",
        help="the guidance whose model is trained (default: %(default)s)",
    )
    tune.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="a model or a training setting; repeatable"
    )
    consent(tune)
    for step in (models, pairs, tune):
        progress(step)
        common(step)


def _import(steps: Any) -> Any:
    """Add the step `import`."""
    models = steps.add_parser(
        "import",
        help="rigged models (glTF, VRM, FBX, .blend) to assets to train on",
        description="Read rigged models with Blender, several at once, into a folder of assets for the step pairs and "
        "for train-prior (docs/training.md). The same command goes on where a stopped one was.",
        allow_abbrev=False,
    )
    models.set_defaults(needs=(), extra="")
    models.add_argument(
        "files", type=Path, nargs="+", metavar="FILES", help=".glb, .gltf, .vrm, .fbx, .blend, or folders"
    )
    models.add_argument("--out", type=Path, required=True, metavar="ASSETS", help="folder to write, or to add to")
    models.add_argument(
        "--licence",
        required=True,
        metavar="NAME",
        help="of these models, for the catalogue: CC0, MIT, CC-BY-4.0, ...; your own, for yourself: CC0",
    )
    models.add_argument("--author", default="", metavar="NAME", help="of these models, for the credits")
    models.add_argument(
        "--family", default="", metavar="NAME", help="of these models; otherwise those of one skeleton are one"
    )
    models.add_argument("--jobs", type=positive, default=2, metavar="N", help="Blenders at once (default: %(default)s)")
    models.add_argument(
        "--minutes", type=positive, default=10, metavar="N", help="most for one file (default: %(default)s)"
    )
    models.add_argument("--blender", type=Path, metavar="PATH", help="the Blender that reads; otherwise this one")
    models.add_argument("--into", type=Path, help=argparse.SUPPRESS)  # these two: what a Blender is started with
    models.add_argument("--name", default="", help=argparse.SUPPRESS)
    return models
