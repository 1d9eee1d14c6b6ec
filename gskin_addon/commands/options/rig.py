# SPDX-License-Identifier: GPL-3.0-or-later
"""The options of `gskin rig`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core.guidance import DEFAULT_GUIDANCE, GUIDANCE
from ...core.job.settings import PRESET_FIELD
from ...core.job.up_axis import UP_CHOICES
from ...core.render.backends import AUTO, BACKENDS
from ...core.render.camera import VIEW_COUNTS
from ...core.skeleton.fit import KINDS
from ...core.skinning.fields import OPTIONS as FIELD_OPTIONS
from ...core.skinning.fields import WEIGHT_FIELDS
from ...core.skinning.initial import DEFAULT_INITIAL, INITIAL_WEIGHTS
from ...core.skinning.losses import LossWeights
from ...core.skinning.presets import DEFAULT_PRESET, PRESETS
from ...core.splats.axes import UP_AXES
from .fit import fitting
from .numbers import aspect, count, scale, seed
from .shared import common, consent, front, progress, up

_FIELD_OPTIONS = "; ".join(f"{name}: {', '.join(options)}" for name, options in FIELD_OPTIONS.items())


def add(commands: Any) -> None:
    """Add `gskin rig` to the commands."""
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
    fitting(rig)
    rig.add_argument("--armature-name", metavar="NAME", help="which armature, where the file has several")
    rig.add_argument("--out", type=Path, required=True, metavar="OUT", help="what to write: .blend or .glb")
    rig.add_argument("--weights", type=Path, metavar="W.npz", help="also write the weights as arrays")
    rig.add_argument(
        "--mesh",
        type=Path,
        metavar="PROXY",
        help="a mesh of the same object (.obj, .ply, .glb, .npz, ...): learn weights on it, hang the splats on it",
    )
    rig.add_argument(
        "--edges-only",
        action="store_true",
        help="with --mesh: splats turn and shear as the mesh's edges alone say, as in the paper (default: what is "
        "scaled is scaled along its normals, too)",
    )
    rig.add_argument("--mesh-up", choices=UP_AXES, help="that mesh's up axis (default: y for .glb and .gltf, else z)")
    up(rig, UP_CHOICES, "the splat file's up axis, or auto to guess it (default: by the format's rules, else z)")
    rig.add_argument(
        "--rig-scale",
        type=scale,
        metavar="auto|F",
        help="scale the armature by F, or by what its unit is off (default: say so and leave it)",
    )
    rig.add_argument("--drop-invalid", action="store_true", help="leave out splats with NaN or infinite values")
    rig.add_argument("--drop-strays", action="store_true", help="leave out splats off the body and faint giants")
    rig.add_argument(
        "--max-aspect", type=aspect, default=0.0, metavar="R", help="widen needles longer than R times their width"
    )
    rig.add_argument("--isotropic", action="store_true", help="make every splat a ball of the same area")
    rig.add_argument(
        "--walls",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="marked splats, as of gskin weights --select: weights do not go from them to others; given twice or more, "
        "each FILE is one side of a wall, and splats in none are open to all",
    )
    rig.add_argument(
        "--field",
        choices=(PRESET_FIELD, *WEIGHT_FIELDS),
        default=PRESET_FIELD,
        help="what the weights are a function of (default: as the preset says)",
    )
    rig.add_argument(
        "--field-option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"a setting of that field, as {_FIELD_OPTIONS}; repeatable",
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
        help=f"initial weights (default: {DEFAULT_INITIAL}; visibility in the preset paper)",
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
    consent(rig)
    front(rig)
    rig.add_argument("--preset", choices=tuple(PRESETS), default=DEFAULT_PRESET, help="effort (default: %(default)s)")
    rig.add_argument("--views", type=int, choices=VIEW_COUNTS, help="sides that guidance images show (default: 4)")
    rig.add_argument(
        "--loss",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"a factor of the loss, of {', '.join(LossWeights.names())}; repeatable",
    )
    rig.add_argument(
        "--max-influences",
        type=count,
        metavar="N",
        help="bones per splat in the result, 0 for no limit (default: 4; 0 in the preset paper)",
    )
    rig.add_argument(
        "--no-paintable",
        dest="paintable",
        action="store_false",
        help="of a .blend: no fabric under the splats for Blender's brushes (Make Paintable)",
    )
    rig.add_argument("--seed", type=seed, default=0, metavar="N", help="same seed, same weights (default: 0)")
    rig.add_argument(
        "--job-dir", type=Path, metavar="D", help="keep the job here; the same command resumes a stopped one"
    )
    rig.add_argument("--python", metavar="PYTHON", default="", help="the Python with torch that does the work")
    progress(rig)
    common(rig)
