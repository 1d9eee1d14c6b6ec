# SPDX-License-Identifier: GPL-3.0-or-later
"""The parser of the command line, made of the options of every command."""

from __future__ import annotations

import argparse

<<<<<<< HEAD
from ..core.guidance import DEFAULT_GUIDANCE, GUIDANCE
from ..core.job.settings import FRONTS, PRESET_FIELD
from ..core.job.up_axis import UP_CHOICES
from ..core.render.backends import AUTO, BACKENDS
from ..core.skeleton.fit import KINDS, LOOKS
from ..core.skinning.fields import WEIGHT_FIELDS
from ..core.skinning.initial import DEFAULT_INITIAL, INITIAL_WEIGHTS
from ..core.skinning.presets import DEFAULT_PRESET, PRESETS
from ..core.splats.axes import UP_AXES
from ..core.worker.runtime_choice import BACKENDS as TORCH_BACKENDS
=======
from .options import convert, pose, render, rig, runtime, train_guidance, train_prior, weights
from .options.shared import Parser
>>>>>>> main

VERSION = "0.2.0"


def build() -> argparse.ArgumentParser:
    """The parser of all commands; `options.command` names the module that runs."""
    parser = Parser(
        prog="gskin",
        description="Auto-skin Gaussian splats: weights, posing and rigged glTF.",
        epilog="Exit codes: 0 done, 2 bad input, 1 failure, 130 cancelled.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"gskin {VERSION}")
<<<<<<< HEAD
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    _rig(commands)
    _fit(commands)
    _pose(commands)
    _render(commands)
    _convert(commands)
    _weights(commands)
    _train_guidance(commands)
    _train_prior(commands)
    _runtime(commands)
    return parser


def _rig(commands: Any) -> None:
    rig = commands.add_parser(
        "rig",
        help="bind splats to an armature with automatic weights",
        description="Bind splats to an armature with automatic weights and save the rigged splats.",
        allow_abbrev=False,
    )
    rig.add_argument("splats", type=Path, metavar="SPLATS", help="Gaussian splats (.ply, .spz, .sog, ...)")
    skeleton = rig.add_mutually_exclusive_group(required=True)
    skeleton.add_argument("--armature", type=Path, metavar="RIG", help="armature: .blend, .glb, .gltf or .fbx")
    skeleton.add_argument("--fit", choices=tuple(KINDS), help="fit a skeleton of this kind to the splats")
    _fitting(rig)
    rig.add_argument("--armature-name", metavar="NAME", help="which armature, where the file has several")
    rig.add_argument("--out", type=Path, required=True, metavar="OUT", help="what to write: .blend or .glb")
    rig.add_argument("--weights", type=Path, metavar="W.npz", help="also write the weights as arrays")
    rig.add_argument(
        "--mesh",
        type=Path,
        metavar="PROXY",
        help="a mesh of the same object (.obj, .ply, .glb, .npz, ...): learn weights on it, hang the splats on it",
    )
    rig.add_argument("--mesh-up", choices=UP_AXES, help="that mesh's up axis (default: y for .glb and .gltf, else z)")
    _up(rig, UP_CHOICES, "the splat file's up axis, or auto to guess it (default: by the format's rules, else z)")
    rig.add_argument(
        "--rig-scale",
        type=_scale,
        metavar="auto|F",
        help="scale the armature by F, or by what its unit is off (default: say so and leave it)",
    )
    rig.add_argument("--drop-invalid", action="store_true", help="leave out splats with NaN or infinite values")
    rig.add_argument("--drop-strays", action="store_true", help="leave out splats off the body and faint giants")
    rig.add_argument(
        "--max-aspect", type=_aspect, default=0.0, metavar="R", help="widen needles longer than R times their width"
    )
    rig.add_argument("--isotropic", action="store_true", help="make every splat a ball of the same area")
    rig.add_argument(
        "--field",
        choices=(PRESET_FIELD, *WEIGHT_FIELDS),
        default=PRESET_FIELD,
        help="what the weights are a function of (default: as the preset says)",
    )
    rig.add_argument(
        "--rasterizer",
        choices=(AUTO, *BACKENDS),
        default=AUTO,
        help="what draws the splats (default: the fastest that works here)",
    )
    rig.add_argument(
        "--init",
        choices=tuple(INITIAL_WEIGHTS),
        default=DEFAULT_INITIAL,
        help="initial weights (default: %(default)s)",
    )
    rig.add_argument(
        "--init-model", type=Path, metavar="MODEL.safetensors", help="another model for --init learned (train-prior)"
    )
    rig.add_argument(
        "--guidance",
        choices=tuple(GUIDANCE),
        default=DEFAULT_GUIDANCE,
        help="what makes the guidance images (default: %(default)s)",
    )
    rig.add_argument(
        "--guidance-option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of that guidance; repeatable",
    )
    _consent(rig)
    _front(rig)
    rig.add_argument("--preset", choices=tuple(PRESETS), default=DEFAULT_PRESET, help="effort (default: %(default)s)")
    rig.add_argument("--max-influences", type=_positive, default=4, metavar="N", help="bones per splat (default: 4)")
    rig.add_argument("--seed", type=_seed, default=0, metavar="N", help="same seed, same weights (default: 0)")
    rig.add_argument(
        "--job-dir", type=Path, metavar="D", help="keep the job here; the same command resumes a stopped one"
    )
    rig.add_argument("--python", metavar="PYTHON", default="", help="the Python with torch that does the work")
    _progress(rig)
    _common(rig)


def _fit(commands: Any) -> None:
    fit = commands.add_parser(
        "fit",
        help="fit a skeleton to splats, or bring one of another program into them",
        description="Fit the skeleton of a person or an animal to splats, or bring the joints of another program into "
        "them, and save it: with the splats as .blend, or the bones alone as .json.",
        allow_abbrev=False,
    )
    fit.add_argument("splats", type=Path, metavar="SPLATS", help="Gaussian splats (.ply, .spz, .sog, ...)")
    fit.add_argument("--kind", choices=tuple(KINDS), help="what body it is")
    fit.add_argument(
        "--skeleton", type=Path, metavar="FILE", help="joints as .txt or .npz, .bvh, .fbx, .vrm, .glb or .blend"
    )
    fit.add_argument("--out", type=Path, required=True, metavar="OUT", help="what to write: .blend or .json")
    _up(fit, UP_CHOICES, "the splat file's up axis (default: guessed)")
    fit.add_argument("--drop-invalid", action="store_true", help="leave out splats with NaN or infinite values")
    _fitting(fit)
    _common(fit)


def _fitting(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--looks-to", choices=("auto", *LOOKS), default="auto", help="of a fit: to where the body looks, z up"
    )
    parser.add_argument(
        "--sides",
        choices=("auto", "alike", "apart"),
        default="auto",
        help="of a fit: both sides as mirror images, or each as it is (default: where they nearly are)",
    )
    parser.add_argument(
        "--landmark",
        action="append",
        nargs=4,
        default=[],
        metavar=("NAME", "X", "Y", "Z"),
        help="of a fit: where hand.L, foot.R, head and so on end, z up; repeatable",
    )
    parser.add_argument(
        "--no-rigify",
        dest="rigify",
        action="store_false",
        help="of a fit: plain bones, without Rigify's settings",
    )


def _pose(commands: Any) -> None:
    pose = commands.add_parser(
        "pose",
        help="pose rigged splats and save them",
        description="Pose rigged splats by a frame of an action or by turning bones, and save the result.",
        allow_abbrev=False,
    )
    pose.add_argument("source", type=Path, metavar="RIGGED.blend", help="what `gskin rig` wrote")
    pose.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="OUT",
        help="what to write: .blend, .glb with the rig, or posed splats (.ply, .spz, .sog, ...)",
    )
    _up(pose, UP_AXES, "the up axis of posed splats (default: by their format's rules, else as the splats came in)")
    _posing(pose)
    _common(pose)


def _render(commands: Any) -> None:
    render = commands.add_parser(
        "render",
        help="draw splats to a picture",
        description="Draw splats (.ply, .spz, .sog, ...) or rigged splats (.blend) in a pose to a PNG; with --view "
        "camera all splats of a .blend from its scene's camera, with alpha, in the scene's resolution, behind its "
        "other objects.",
        allow_abbrev=False,
    )
    render.add_argument("source", type=Path, metavar="SPLATS", help="splats, or .blend that `gskin rig` wrote")
    render.add_argument("--out", type=Path, required=True, metavar="IMAGE.png")
    render.add_argument("--view", choices=(*VIEWS, "camera"), default="front-left", help="(default: %(default)s)")
    render.add_argument("--frames", metavar="A-B", help="with --view camera: these frames, as 1-24 or 1-24x2")
    render.add_argument("--resume", action="store_true", help="with --view camera: leave frames that are there")
    render.add_argument(
        "--depth", action="store_true", help="with --view camera: also depth, as Z of an .exr or beside a .png"
    )
    render.add_argument("--size", type=_positive, default=512, metavar="PIXELS", help="(default: %(default)s)")
    render.add_argument(
        "--background", type=_unit, nargs=3, default=[1.0, 1.0, 1.0], metavar=("R", "G", "B"), help="0 to 1"
    )
    render.add_argument(
        "--color",
        choices=("splats", "weights", "confidence"),
        default="splats",
        help="the splats' own colours, one per bone, or how sure the weights are, red to blue",
    )
    render.add_argument(
        "--engine",
        choices=("gskin", "cycles"),
        default="gskin",
        help="our rasteriser, or Blender's Cycles (.blend)",
    )
    _up(render, UP_AXES, "the splat file's up axis (default: by the format's rules, else z)")
    render.add_argument("--python", metavar="PYTHON", default="", help="the Python that draws for --view camera")
    _progress(render)
    _front(render)
    _posing(render)
    _common(render)


def _weights(commands: Any) -> None:
    weights = commands.add_parser(
        "weights",
        help="change the weights of rigged splats",
        description="Change the weights of rigged splats, in the order in which the changes are given. Every changed "
        "splat keeps its four strongest bones; weights sum to 1.",
        allow_abbrev=False,
    )
    weights.set_defaults(changes=[])
    weights.add_argument("source", type=Path, metavar="RIGGED.blend", help="what `gskin rig` wrote")
    weights.add_argument("--out", type=Path, metavar="OUT", help="what to write: .blend or .glb")
    weights.add_argument("--weights", type=Path, metavar="W.npz", help="write the weights as arrays")
    weights.add_argument("--object", metavar="NAME", help="which splats, where the file has several")
    weights.add_argument("--smooth", type=_positive, metavar="N", action=_Change, help="N steps towards the neighbours")
    weights.add_argument(
        "--sharpen", type=_unit, metavar="AMOUNT", action=_Change, help="0 nothing, 1 only the strongest bone"
    )
    weights.add_argument(
        "--mirror", choices=("left", "right"), action=_Change, help="the side whose weights the other one gets"
    )
    weights.add_argument("--limit", type=_positive, metavar="N", action=_Change, help="at most N bones a splat")
    weights.add_argument("--normalise", nargs=0, action=_Change, help="make the weights of each splat sum to 1")
    weights.add_argument("--to-bone", metavar="BONE", action=_Change, help="selected splats follow this bone alone")
    weights.add_argument(
        "--flood", nargs=2, metavar=("BONE", "WEIGHT"), action=_Change, help="one weight for the selected splats"
    )
    weights.add_argument(
        "--follow-neighbours", nargs=0, action=_Change, help="selected splats take weights from those around them"
    )
    weights.add_argument(
        "--select", type=Path, metavar="FILE", help="splats to change: .npz with `selected`, or a text of their numbers"
    )
    weights.add_argument(
        "--select-bone", action="append", default=[], metavar="BONE", help="splats that follow it most; repeatable"
    )
    weights.add_argument(
        "--rim", type=_length, default=0.0, metavar="METRES", help="way over which --to-bone fades out (default: 0)"
    )
    weights.add_argument(
        "--lock", action="append", default=[], metavar="BONE", help="a bone whose weights stay; repeatable"
    )
    _common(weights)


class _Change(argparse.Action):
    """Collects changes in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        if self.dest == "flood":
            try:
                values = (values[0], _unit(values[1]))
            except (ValueError, argparse.ArgumentTypeError):
                parser.error(f"argument --flood: the weight '{values[1]}' is not a number in 0..1")
        namespace.changes = [*namespace.changes, (self.dest, values)]


def _train_guidance(commands: Any) -> None:
    train = commands.add_parser(
        "train-guidance",
        help="make image pairs from rigged assets, and fine-tune a guidance model on them",
        description="Fine-tune a guidance model as the paper does, in two steps; see docs/guidance.md.",
        allow_abbrev=False,
    )
    steps = train.add_subparsers(dest="step", required=True, metavar="STEP", parser_class=_Parser)
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
        "--poses", type=_positive, default=71, metavar="N", help="per asset and view, of four (default: %(default)s)"
    )
    pairs.add_argument("--size", type=_size, default=512, metavar="PIXELS", help="(default: %(default)s)")
    pairs.add_argument("--splats", type=_positive, default=30_000, metavar="N", help="per asset (default: %(default)s)")
    pairs.add_argument(
        "--validation", type=_unit, default=0.1, metavar="SHARE", help="of the assets, whole families (default: 0.1)"
    )
    pairs.add_argument(
        "--leave-out", action="append", default=[], metavar="FAMILY", help="keep a family for tests; repeatable"
    )
    pairs.add_argument("--per-family", type=_positive, default=0, metavar="N", help="most assets of a family")
    pairs.add_argument(
        "--any-licence", action="store_true", help="also assets whose licence binds what is learned from them"
    )
    pairs.add_argument("--seed", type=_seed, default=0, metavar="N", help="same seed, same pairs (default: 0)")
    tune = steps.add_parser(
        "tune",
        help="fine-tune LightningDrag weights on image pairs",
        description="Fine-tune LightningDrag weights on image pairs. The same command goes on where a stopped one was.",
        allow_abbrev=False,
    )
    tune.set_defaults(needs=("torch", "diffusers", "accelerate"), extra="gskin_addon[worker,diffusion]")
    tune.add_argument("pairs", type=Path, metavar="PAIRS", help="what `train-guidance pairs` wrote")
    tune.add_argument("--out", type=Path, required=True, metavar="MODEL", help="folder to write")
    tune.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="a model or a training setting; repeatable"
    )
    _consent(tune)
    for step in (pairs, tune):
        _progress(step)
        _common(step)


def _consent(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--allow-download", action="store_true", help="fetch a model named by its hub id, where it is not here yet"
    )


def _progress(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--progress",
        choices=("auto", "bar", "lines", "json", "none"),
        default="auto",
        help="on stderr: a bar on terminals, else lines (auto); or the worker's JSON lines",
    )


def _train_prior(commands: Any) -> None:
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
    train.add_argument("--steps", type=_positive, default=TRAINING_STEPS, metavar="N", help="(default: %(default)s)")
    train.add_argument("--creatures", type=int, default=TRAINING_CREATURES, metavar="N",
                       help="made-up bodies (default: %(default)s)")  # fmt: skip
    train.add_argument("--networks", type=_positive, default=TRAINING_NETWORKS, metavar="N",
                       help="trained in turn, their answers are averaged (default: %(default)s)")  # fmt: skip
    train.add_argument("--seed", type=_seed, default=0, metavar="N", help="same seed, same model (default: 0)")
    train.add_argument("--cache", type=Path, metavar="D", help="where described bodies are kept, for further runs")
    train.add_argument("--threads", type=_positive, default=2, metavar="N", help="(default: %(default)s)")
    _progress(train)
    _common(train)


def _runtime(commands: Any) -> None:
    runtime = commands.add_parser(
        "runtime",
        help="install the Python with torch that guidance needs",
        description="Install, look at, repair or remove the learning runtime (docs/install.md). Stopped, the same "
        "command goes on where it was.",
        allow_abbrev=False,
    )
    actions = runtime.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser)
    tips = {
        "install": "make it, complete it or bring it up to date",
        "status": "say how it is; exit code 2 where none works",
        "repair": "compare every file with what was installed, and fetch again what is not whole",
        "remove": "delete it",
    }
    for name, tip in tips.items():
        action = actions.add_parser(name, help=tip, description=tip[:1].upper() + tip[1:] + ".", allow_abbrev=False)
        action.add_argument("--folder", type=Path, metavar="F", help="its folder (default: $GSKIN_RUNTIME, or yours)")
        if name in ("install", "repair"):
            action.add_argument(
                "--backend",
                default="auto",
                choices=("auto", *TORCH_BACKENDS),
                help="what torch computes on (default: as the drivers say)",
            )
            action.add_argument(
                "--no-diffusion", dest="diffusion", action="store_false", help="without what diffusion guidances need"
            )
            source = action.add_mutually_exclusive_group()
            source.add_argument("--index", default="", metavar="URL", help="an index, or pip: as pip is set up")
            source.add_argument("--wheels", type=Path, metavar="FOLDER", help="a folder of wheels, without network")
            action.add_argument("--base", metavar="PYTHON", help="the Python to build on (default: this one)")
            _progress(action)
        if name == "remove":
            action.add_argument("--yes", action="store_true", help="really")
        _common(action)


def _convert(commands: Any) -> None:
    convert = commands.add_parser(
        "convert",
        help="turn a file of splats into another format",
        description="Turn a file of splats into the format that the output's name asks for (docs/formats.md).",
        allow_abbrev=False,
    )
    convert.add_argument("source", type=Path, metavar="IN", help="splats: .ply, .spz, .sog, .glb, .splat, .ksplat")
    convert.add_argument("out", type=Path, metavar="OUT", help="what to write; .compressed.ply for the compressed one")
    convert.add_argument("--up", choices=UP_AXES, help="IN's up axis (default: by its format's rules, else -y)")
    convert.add_argument("--out-up", choices=UP_AXES, help="OUT's up axis (default: by its format's rules, else -y)")
    convert.add_argument("--drop-invalid", action="store_true", help="leave out splats with NaN or infinite values")
    _common(convert)


def _up(parser: argparse.ArgumentParser, choices: Sequence[str], tip: str) -> None:
    parser.add_argument("--up", "--ply-up", dest="up", choices=tuple(choices), help=tip)


def _front(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--front",
        choices=tuple(FRONTS),
        default="-y",
        help="the side that the object faces (default: %(default)s); write --front=-x",
    )


def _posing(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--object", metavar="NAME", help="which splat object, where the file has several")
    parser.add_argument("--action", metavar="NAME", help="the action of the armature to take the pose from")
    parser.add_argument("--slot", metavar="NAME", help="which slot of that action, where several fit the armature")
    parser.add_argument("--frame", type=float, metavar="F", help="the frame to take the pose from")
    parser.add_argument(
        "--rotate",
        action="append",
        nargs=4,
        default=[],
        metavar=("BONE", "X", "Y", "Z"),
        help="turn a bone by a rotation vector in degrees, along the world's axes at rest; repeatable",
    )
    parser.add_argument(
        "--set",
        action="append",
        nargs=3,
        default=[],
        metavar=("BONE", "PROPERTY", "VALUE"),
        help="set a custom property of a bone, such as a switch between FK and IK; repeatable",
    )


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--verbose", action="store_true", help="show what Blender prints, and where an error happened")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


def _length(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{value} is not a length")
    return value


def _size(text: str) -> int:
    value = int(text)
    if value < 64 or value % 64:
        raise argparse.ArgumentTypeError(f"{value} is not a multiple of 64")
    return value


def _aspect(text: str) -> float:
    value = float(text)
    if not 1.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


def _scale(text: str) -> float | str:
    if text == AUTO_SCALE:
        return text
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{value} is not above 0")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**32:
        raise argparse.ArgumentTypeError(f"{value} is not in 0..4294967295")
    return value


def _unit(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{value} is not in 0..1")
    return value


# argparse names the converter in its message
_positive.__name__, _seed.__name__, _unit.__name__ = "whole number", "whole number", "number"
_scale.__name__ = "auto, or number"
_size.__name__, _aspect.__name__, _length.__name__ = "whole number", "number", "number"
=======
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    rig.add(commands)
    pose.add(commands)
    render.add(commands)
    convert.add(commands)
    weights.add(commands)
    train_guidance.add(commands)
    train_prior.add(commands)
    runtime.add(commands)
    return parser
>>>>>>> main
