# SPDX-License-Identifier: GPL-3.0-or-later
"""What a method is given, as files that other programs read: `python -m benchmarks.quality.export FOLDER`.

For each asset a folder: splats.ply (INRIA layout, z up), input.npz (means, quats, scales, opacities, sh; bones,
parents, heads, tails; z up, metres), skeleton.txt (RigNet's joints, root and hier lines; y up) and, with --meshes,
proxy.obj, a closed surface around the splats (y up). No weights, no animation, no true mesh. tasks.json names the
assets, the protocol, and digests of the splats.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.assets import ASSETS, RiggedSplats, load_asset
from gskin_addon.core.errors import InputError
from gskin_addon.core.files import write_arrays, write_json, write_text
from gskin_addon.core.rig.rignet_file import write_rignet
from gskin_addon.core.splats.axes import up_rotation
from gskin_addon.core.splats.ply import write_ply

from .catalog import Entry, balanced, candidates, entry_of
from .protocol import Protocol

SCHEMA, VERSION = "gskin-skinning-tasks", 1


def main() -> int:
    """Write the tasks; 2 where the assets are missing or there is no such asset."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality.export", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--assets", default="", help="names, separated by commas; default all candidates")
    parser.add_argument("--sample", type=int, default=0, help="this many, balanced over categories and families")
    parser.add_argument("--splats", type=int, default=Protocol.splats)
    parser.add_argument("--meshes", action="store_true", help="also a proxy mesh of each (needs igl)")
    options = parser.parse_args()
    try:
        entries = chosen_entries(options.assets, options.sample)
        export(options.folder, entries, Protocol(splats=options.splats), meshes=options.meshes)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def chosen_entries(names: str, sample: int) -> list[Entry]:
    """The named assets, or `sample` (0: all) of the candidates in the balanced order.

    Raises:
        InputError: no catalogue, or no such asset.
    """
    if not (ASSETS / "catalog.json").is_file():
        raise InputError(f"'{ASSETS}' has no catalog.json; set GSKIN_ASSETS to the folder that holds it and npz/.")
    if not names:
        entries = candidates()
        return balanced(entries, sample or len(entries))
    try:
        return [entry_of(name) for name in names.split(",")]
    except KeyError as error:
        raise InputError(f"'{ASSETS}' has no asset {error}; names are in its catalog.json.") from None


def export(folder: Path, entries: list[Entry], protocol: Protocol, *, meshes: bool = False) -> None:
    """Write a folder for each entry, and tasks.json.

    Raises:
        InputError: an asset that cannot be read.
    """
    tasks = []
    for entry in entries:
        asset = load_asset(entry.name, protocol.splats, protocol.seed, unused_bones=protocol.unused_bones)
        write_task(folder / entry.name, asset, mesh=meshes)
        tasks.append({
            "asset": entry.name, "category": entry.category, "family": entry.family,
            "splats": len(asset.cloud.means), "bones": asset.skeleton.count, "splats_sha256": splats_digest(asset),
        })  # fmt: skip
        print(f"{entry.name}: {len(asset.cloud.means):,} splats, {asset.skeleton.count} bones", flush=True)
    told = {"schema": SCHEMA, "version": VERSION, "protocol": protocol.key, "seed": protocol.seed, "tasks": tasks}
    write_json(folder / "tasks.json", told)


def write_task(folder: Path, asset: RiggedSplats, *, mesh: bool) -> None:
    """What a method is given of one asset."""
    folder.mkdir(parents=True, exist_ok=True)
    cloud, skeleton = asset.cloud, asset.skeleton
    write_ply(folder / "splats.ply", cloud)
    given = {name: getattr(cloud, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    bones = {"bones": np.array(skeleton.names), "parents": skeleton.parents, "heads": skeleton.heads}
    write_arrays(folder / "input.npz", given | bones | {"tails": skeleton.tails})
    write_rignet(folder / "skeleton.txt", np.zeros((0, skeleton.count)), skeleton)
    if mesh:
        from .methods.heat_proxy import proxy_mesh

        write_obj(folder / "proxy.obj", *proxy_mesh(cloud))


def write_obj(path: Path, verts: NDArray[Any], faces: NDArray[Any]) -> None:
    """Vertices (V, 3), turned from z up to y up, and triangles (F, 3)."""
    lines = [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in (verts @ up_rotation("y")).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
    write_text(path, "\n".join(lines) + "\n")


def splats_digest(asset: RiggedSplats) -> str:
    """SHA-256 of the centres, rounded to 1e-5 of the size: the same splats on every machine have the same."""
    lower, upper = asset.cloud.bounds()
    step = 1e-5 * float(np.linalg.norm(upper - lower))
    return hashlib.sha256(np.round(asset.cloud.means / step).astype("<i8").tobytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
