# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitted skeletons of assets whose families the network never saw: where their joints land, and what Auto-Skin makes.

    python -m benchmarks.bench_fit human --out out/fit [--folds 5] [--share 110] [--steps 1500] [--skin 20] [--retrain]

Networks and examples stay in the folder. Joints: mean distance to where the artist's bones begin, in % of the diagonal
of the splats, front found by the fit. Auto-Skin: bones of the artist that begin at the joints of the fit, with all
others' weights given to the nearest ancestor among them, against the fitted bones of the same joints: mean position
error of learned weights in random poses of the artist's joints, in % of the diagonal, and the ratio of the two.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from gskin_addon.core.files import read_arrays, write_arrays
from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.rig.skeleton import Skeleton
from gskin_addon.core.skeleton import fit as fitting
from gskin_addon.core.skeleton.joint_tree import bone_ends
from gskin_addon.core.skeleton.joints import HUMAN, QUADRUPED, both_sides
from gskin_addon.core.skeleton.votes import VoteNetwork
from gskin_addon.core.skinning.learned.predict import learned_weights
from gskin_addon.core.splats.from_mesh import sample_mesh
from gskin_addon.core.training.skeleton.collect import Subject, examples_of, subjects
from gskin_addon.core.training.skeleton.examples import Example
from gskin_addon.core.training.skeleton.train import train

from .assets import ASSETS
from .metrics import POSES, held_out_poses

Array = np.ndarray[Any, Any]

SPLATS = 20_000
SKINNED_SPLATS = 8_000
SEED = 977

BONES = {
    "human": {"hips": "spine", "neck": "spine.004", "head": "spine.006", "shoulder": "upper_arm", "elbow": "forearm",
              "wrist": "hand", "thigh": "thigh", "knee": "shin", "ankle": "foot", "toe": "toe"},
    "quadruped": {"hips": "spine.004", "neck": "spine.009", "head": "spine.011", "tail": "spine.002",
                  "front_thigh": "front_thigh", "front_foot": "front_foot", "front_toe": "front_toe", "thigh": "thigh",
                  "shin": "shin", "foot": "foot", "toe": "toe"},
}  # fmt: skip
"""The fitted bone that begins at each joint."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=tuple(BONES))
    parser.add_argument("--out", type=Path, default=Path("out/fit"))
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--share", type=int, default=110)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--skin", type=int, default=0, metavar="N", help="Auto-Skin N assets, families take turns")
    parser.add_argument("--retrain", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found = subjects(ASSETS, options.kind)
    folds = fold_of(found, options.folds)
    names = HUMAN if options.kind == "human" else QUADRUPED
    kept: dict[int, VoteNetwork] = {}
    rows = []
    skinned = {subject.asset.name for subject in balanced(found, options.skin)}
    for subject in found:
        fold = folds[subject.asset.family]
        if fold not in kept:
            kept[fold] = network(options, found, folds, fold, names)
        row = judge(options.kind, subject, kept[fold], skin=subject.asset.name in skinned)
        rows.append(row)
        print(" ".join(f"{key}={value:.2f}" if isinstance(value, float) else f"{value}" for key, value in row.items()
                       if key != "joints"), flush=True)  # fmt: skip
    tell(rows, both_sides(names))


def fold_of(found: list[Subject], folds: int) -> dict[str, int]:
    """The fold of each family; large families are spread over the folds."""
    sizes = Counter(subject.asset.family for subject in found)
    return {family: number % folds for number, (family, _) in enumerate(sorted(sizes.items(), key=lambda f: -f[1]))}


def network(
    options: argparse.Namespace, found: list[Subject], folds: dict[str, int], fold: int, names: tuple[str, ...]
) -> VoteNetwork:
    """A network that never saw the families of a fold."""
    path = options.out / f"{options.kind}-{fold}-of-{options.folds}.npz"
    if options.retrain or not path.is_file():
        chosen = [pair for pair in all_examples(options, found) if folds[pair[0]] != fold]
        families = [family for family, _ in chosen]
        learned = train([example for _, example in chosen], families, names, steps=options.steps)
        write_arrays(path, learned)
        print(f"fold {fold}: trained on {len(chosen)} examples", flush=True)
    return VoteNetwork(read_arrays(path))


def all_examples(options: argparse.Namespace, found: list[Subject]) -> list[tuple[str, Example]]:
    """Examples with their families, made once."""
    path = options.out / f"{options.kind}-examples-{options.share}.npz"
    if not path.is_file():
        made = examples_of(found, options.kind, options.share)
        write_arrays(path, {
            "family": np.array([subject.asset.family for subject, _ in made]),
            "values": np.stack([example.values for _, example in made]).astype(np.float16),
            "joints": np.stack([example.joints for _, example in made]),
            "diagonal": np.array([example.diagonal for _, example in made]),
        })  # fmt: skip
    data = read_arrays(path)
    return [
        (str(family), Example(values, joints, float(diagonal)))
        for family, values, joints, diagonal in zip(
            data["family"], data["values"].astype(np.float32), data["joints"], data["diagonal"], strict=True
        )
    ]


def judge(kind: str, subject: Subject, learned: VoteNetwork, *, skin: bool) -> dict[str, Any]:
    """Errors in % of the diagonal."""
    rng = np.random.default_rng(SEED)
    mesh = subject.mesh
    cloud, face, bary = sample_mesh(mesh.verts, mesh.faces, mesh.corner_rgb, SPLATS, rng)
    found = fitting.fit_with(kind, learned, cloud)
    low, high = cloud.bounds()
    diagonal = float(np.linalg.norm(high - low))
    places = {name: found.placement[:3, :3] @ at + found.placement[:3, 3] for name, at in found.joints.items()}
    off = {name: 100 * float(np.linalg.norm(places[name] - mesh.skeleton.heads[bone])) / diagonal
           for name, bone in subject.bones.items() if name in places}  # fmt: skip
    straight = float(found.placement[:3, 1] @ [0, 1, 0]) > 0.7
    row: dict[str, Any] = {
        "asset": subject.asset.name, "family": subject.asset.family, "error": float(np.mean(list(off.values()))),
        "doubt": 100 * found.doubt, "unsure": found.unsure, "clear": found.front_sure,
        "front": "right" if straight else "wrong", "joints": off,
    }  # fmt: skip
    if skin:
        cloud, face, bary = sample_mesh(mesh.verts, mesh.faces, mesh.corner_rgb, SKINNED_SPLATS, rng)
        weights = np.einsum("nk,nkb->nb", bary, mesh.weights[mesh.faces[face]])
        row |= skinning(kind, subject, found, cloud, weights, diagonal)
    return row


def skinning(
    kind: str, subject: Subject, found: fitting.Fit, cloud: Any, weights: Array, diagonal: float
) -> dict[str, float]:
    """Errors of Auto-Skin with the artist's bones and with the fitted ones, on the joints that both have."""
    depth = depths(subject.mesh.skeleton)
    joints = [name for name in subject.bones if name in found.joints]
    joints.sort(key=lambda name: (name != "hips", depth[subject.bones[name]]))
    artist, truth = reduced(subject.mesh.skeleton, weights, [subject.bones[name] for name in joints])
    column = {name: number for number, name in enumerate(joints)}
    skeleton = found.placed()
    of_joint = {f"{BONES[kind][name.partition('.')[0]]}{'.' if '.' in name else ''}{name.partition('.')[2]}": name
                for name in joints}  # fmt: skip
    fitted, _ = learned_weights(cloud, skeleton)
    gathered = np.zeros_like(truth)
    for number in range(skeleton.count):
        at = number
        while at >= 0 and skeleton.names[at] not in of_joint:
            at = int(skeleton.parents[at])
        name = of_joint[skeleton.names[at]] if at >= 0 else joints[0]
        gathered[:, column[name]] += fitted[:, number]
    own, _ = learned_weights(cloud, artist)
    poses = held_out_poses(artist, POSES, SEED)
    points = cloud.means.astype(np.float64)
    right = skin_points(points, truth, poses)

    def error(values: Array) -> float:
        return 100 * float(np.linalg.norm(skin_points(points, values, poses) - right, axis=-1).mean()) / diagonal

    return {"artist": error(own), "fitted": error(gathered)}


def reduced(skeleton: Skeleton, weights: Array, chosen: list[int]) -> tuple[Skeleton, Array]:
    """The bones `chosen` alone, in their order by depth, and weights (N, C): others' go to the nearest chosen ancestor,
    or to the first where there is none."""
    column = {bone: number for number, bone in enumerate(chosen)}
    out = np.zeros((len(weights), len(chosen)), np.float32)
    parents = []
    for bone in range(skeleton.count):
        at = bone
        while at >= 0 and at not in column:
            at = int(skeleton.parents[at])
        out[:, column.get(at, 0)] += weights[:, bone]
    for bone in chosen:
        at = int(skeleton.parents[bone])
        while at >= 0 and at not in column:
            at = int(skeleton.parents[at])
        parents.append(-1 if bone == chosen[0] else column.get(at, 0))
    heads = skeleton.heads[chosen]
    out /= np.maximum(out.sum(axis=1, keepdims=True), 1e-9)
    names = tuple(skeleton.names[bone] for bone in chosen)
    return Skeleton(names, np.array(parents), heads, bone_ends(heads, np.array(parents))), out


def depths(skeleton: Skeleton) -> list[int]:
    """How many ancestors each bone has."""
    out: list[int] = []
    for parent in skeleton.parents:
        out.append(0 if parent < 0 else out[int(parent)] + 1)
    return out


def balanced(found: list[Subject], count: int) -> list[Subject]:
    """`count` subjects, families taking turns."""
    by_family: dict[str, list[Subject]] = defaultdict(list)
    for subject in found:
        by_family[subject.asset.family].append(subject)
    out: list[Subject] = []
    while len(out) < count and any(by_family.values()):
        for members in by_family.values():
            if members and len(out) < count:
                out.append(members.pop(0))
    return out


def tell(rows: list[dict[str, Any]], names: tuple[str, ...]) -> None:
    """Means over assets and over families."""
    families = defaultdict(list)
    for row in rows:
        families[row["family"]].append(row["error"])
    errors = np.array([row["error"] for row in rows])
    each = np.mean([np.mean(values) for values in families.values()])
    print(f"\n{len(rows)} assets of {len(families)} families: joints off by {errors.mean():.2f} % of the diagonal "
          f"(median {np.median(errors):.2f}); mean of the families {each:.2f}; "
          f"front wrong {sum(row['front'] == 'wrong' for row in rows)}")  # fmt: skip
    for family, values in families.items():
        print(f"| {family} | {len(values)} | {np.mean(values):.2f} |")
    for name in names:
        known = [row["joints"][name] for row in rows if name in row["joints"]]
        print(f"{name} {np.mean(known):.2f}", end="  ")
    skinned = [row for row in rows if "artist" in row]
    if skinned:
        artist, fitted = (np.array([row[key] for row in skinned]) for key in ("artist", "fitted"))
        print(f"\nAuto-Skin of {len(skinned)}: artist's bones {artist.mean():.2f}, fitted {fitted.mean():.2f}, "
              f"ratio of the means {fitted.mean() / artist.mean():.2f}, median {np.median(fitted / artist):.2f}")
    print("\nFront wrong: " + ", ".join(row["asset"] for row in rows if row["front"] == "wrong"))
    asked = [row for row in rows if row["unsure"]]
    print(f"Unsure: {len(asked)} of {len(rows)}; where to look is not clear {sum(not row['clear'] for row in rows)}, "
          f"of these wrong {sum(row['front'] == 'wrong' for row in rows if not row['clear'])}")  # fmt: skip
    doubt = np.array([row["doubt"] for row in rows])
    print(f"\ndoubt against error: correlation {np.corrcoef(doubt, errors)[0, 1]:.2f}; error = "
          f"{np.polyfit(doubt, errors, 1)} @ doubt")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
