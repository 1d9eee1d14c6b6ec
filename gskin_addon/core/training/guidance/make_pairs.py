# SPDX-License-Identifier: GPL-3.0-or-later
"""Making the image pairs of `pairs.py` from rigged assets: random poses of Sec. III-C seen from the four views."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files import write_arrays, write_json
from ...guidance.control import make_signals
from ...guidance.mask import dynamic_mask, painting_mask
from ...guidance.provider import to_bytes
from ...guidance.skeleton_image import project_bones
from ...render.camera import PAPER_AZIMUTHS, paper_views, percentile_bounds
from ...render.rasterizer import render_cloud
from ...rig.lbs import skin_cloud
from ...skinning.extent import unit_frame
from ...skinning.initial import initial_weights
from ..catalogue import Asset, list_assets
from ..rigged import RiggedSplats, load_asset
from .pairs import MANIFEST, SHARDS, VERSION, Pair, encode_image, read_manifest
from .split import TRAIN, VALIDATION, split_families

TRIES = 8
"""Poses drawn for a pair until one changes the image."""

TRUE_MASKS = 0.1
"""Share of the pairs whose mask has no hole where the true pose changes the image; the others have the mask that a
provider is given, which misses some of it. A judgement: no share was tried out on a real model."""

Report = Callable[[float, str], None]
"""Called with the done part (0 to 1) and a few words; raises Cancelled."""


@dataclass(frozen=True)
class PairSettings:
    """What decides a data set.

    poses_per_view: pairs per asset and view; size: of the square images in pixels; splats: per asset; seed: of all
    randomness; validation: share of the assets that validate; per_family: most assets of a family, 0 for all;
    leave_out: families for neither; any_licence: also assets whose licence forbids passing the weights on freely;
    true_masks: share of the pairs whose mask also covers what the true pose changes; shard: most pairs in a file.
    """

    poses_per_view: int = 71
    size: int = 512
    splats: int = 30_000
    seed: int = 0
    validation: float = 0.1
    per_family: int = 0
    leave_out: tuple[str, ...] = ()
    any_licence: bool = False
    true_masks: float = TRUE_MASKS
    shard: int = 256


def make_pairs(assets: Path, out: Path, settings: PairSettings, report: Report) -> dict[str, Any]:
    """Make the data set `out` from the rigged assets in `assets`, or go on with it; returns the manifest.

    The same settings and seed make the same files, in one run or in several. An asset that cannot be used is left
    out and listed in the manifest with the reason.

    Raises:
        InputError: no assets, or `out` holds pairs of other settings. Cancelled: from `report`; what is finished
            stays.
    """
    chosen = split_families(
        list_assets(assets, any_licence=settings.any_licence),
        settings.validation,
        settings.seed,
        leave_out=settings.leave_out,
        per_family=settings.per_family,
    )
    manifest = _begin(out, chosen, settings)
    finished = {shard["file"]: shard for shard in manifest["shards"] if (out / SHARDS / shard["file"]).is_file()}
    plan = [(split, asset) for split in (TRAIN, VALIDATION) for asset in chosen[split]]
    for number, (split, asset) in enumerate(plan):

        def tell(part: float, number: int = number, asset: Asset = asset) -> None:
            report((number + part) / len(plan), f"{asset.name} ({number + 1} of {len(plan)})")

        tell(0.0)
        wanted = _shards(asset, settings)
        if asset.name in manifest["failed"] or finished.keys() >= wanted.keys():
            continue
        try:
            scene = PairScene(load_asset(asset.path, settings.splats, settings.seed), settings.size)
        except InputError as error:
            manifest["failed"][asset.name] = str(error)
            write_json(out / MANIFEST, manifest)
            continue
        for name, jobs in wanted.items():
            if name in finished:
                continue
            arrays = _shard(scene, jobs, asset.name, settings.seed, settings.true_masks, tell)
            write_arrays(out / SHARDS / name, arrays)
            finished[name] = {"file": name, "asset": asset.name, "split": split, "pairs": len(arrays["view"])}
            manifest["shards"] = [finished[file] for file in sorted(finished)]
            write_json(out / MANIFEST, manifest)
    report(1.0, "finished")
    return manifest


def _begin(out: Path, chosen: dict[str, list[Asset]], settings: PairSettings) -> dict[str, Any]:
    """The manifest to go on with: that of the folder, where it is of the same settings and assets."""
    plain = json.loads(json.dumps(asdict(settings)))
    assets = [
        {"name": a.name, "family": a.family, "split": split, "licence": a.license, "author": a.author}
        for split in (TRAIN, VALIDATION)
        for a in chosen[split]
    ]
    if (out / MANIFEST).is_file():
        manifest = read_manifest(out)
        if manifest.get("settings") != plain or manifest.get("assets") != assets:
            raise InputError(f"'{out}' holds image pairs of other settings or assets; choose another folder.")
        return manifest
    if out.is_dir() and any(out.iterdir()):
        raise InputError(f"'{out}' is not empty and holds no image pairs; choose another folder.")
    (out / SHARDS).mkdir(parents=True, exist_ok=True)
    manifest = {"version": VERSION, "settings": plain, "assets": assets, "shards": [], "failed": {}}
    write_json(out / MANIFEST, manifest)
    return manifest


def _shards(asset: Asset, settings: PairSettings) -> dict[str, list[tuple[float, int, int]]]:
    """The shards of an asset by file name: for each pair the done part of the asset, the view, the pose's number."""
    mark = hashlib.blake2b(asset.name.encode(), digest_size=3).hexdigest()
    stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in asset.name)[:40]
    jobs = [(view, pose) for view in range(len(PAPER_AZIMUTHS)) for pose in range(settings.poses_per_view)]
    whole = [(number / len(jobs), view, pose) for number, (view, pose) in enumerate(jobs)]
    return {
        f"{stem}-{mark}-{first // settings.shard:03d}.npz": whole[first : first + settings.shard]
        for first in range(0, len(whole), settings.shard)
    }


def _shard(
    scene: PairScene,
    jobs: list[tuple[float, int, int]],
    name: str,
    seed: int,
    true_masks: float,
    tell: Callable[[float], None],
) -> dict[str, NDArray[Any]]:
    """The arrays of a shard, see `pairs.py`."""
    arrays: dict[str, NDArray[Any]] = {}
    views: list[int] = []
    for done, view, pose in jobs:
        tell(done)
        rng = np.random.default_rng(_seed(seed, name, view, pose))
        pair = scene.pair(view, rng, true_masks)
        if pair is None:
            continue  # nothing moves in this view, whatever the pose
        number = len(views)
        views.append(view)
        arrays[f"rest_{view}"] = encode_image(pair.rest)
        arrays[f"posed_{number}"], arrays[f"mask_{number}"] = encode_image(pair.posed), encode_image(pair.mask)
        arrays[f"handles_{number}"], arrays[f"targets_{number}"] = pair.handles, pair.targets
        if pair.bones is not None:
            arrays[f"bones_{number}"] = np.stack([pair.bones.rest, pair.bones.posed])
            arrays[f"bone_{number}"] = pair.bones.bone
    return {**arrays, "view": np.array(views, np.int16)}


class PairScene:
    """A rigged asset, ready to be posed and seen from the paper's four views."""

    def __init__(self, asset: RiggedSplats, size: int) -> None:
        """size: of the square images, in pixels."""
        centre, diagonal = unit_frame(asset.cloud.means)  # Eq. 6 holds in unit size
        cloud = replace(
            asset.cloud,
            means=((asset.cloud.means - centre) / diagonal).astype(np.float32),
            scales=(asset.cloud.scales / diagonal).astype(np.float32),
        )
        skeleton = asset.skeleton.moved(np.eye(3), 1.0 / diagonal, -centre / diagonal)
        self.asset = asset = replace(asset, cloud=cloud, skeleton=skeleton, clip=None)
        self.cameras = paper_views(*percentile_bounds(asset.cloud.means), size)
        renders = [render_cloud(asset.cloud, camera) for camera in self.cameras]
        self.rest = [image for image, _ in renders]
        masks = np.stack([alpha > 0.5 for _, alpha in renders])
        self.initial = initial_weights("visibility", asset.cloud, asset.skeleton, masks, self.cameras)

    def pair(self, view: int, rng: np.random.Generator, true_masks: float = TRUE_MASKS) -> Pair | None:
        """One random pose of Sec. III-C in `view`; None where `TRIES` poses change nothing that is seen.

        The mask is the one that a provider is given, from the paper's initial weights and the control points, holes
        and all; in a share of `true_masks` together with what the true pose changes.
        """
        asset, camera, rest = self.asset, self.cameras[view], self.rest[view]
        for _ in range(TRIES):
            (signal,) = make_signals(asset.skeleton, [camera], 1, rng)
            posed, guessed = (
                render_cloud(skin_cloud(asset.cloud, weights, signal.transforms, rotate_sh=False), camera)[0]
                for weights in (asset.weights, self.initial)
            )
            moved = dynamic_mask(rest, posed)
            mask = painting_mask(rest, guessed, signal.handles, signal.targets)
            whole = rng.random() < true_masks
            if moved.any() and mask.any() and len(signal.handles):
                return Pair(
                    to_bytes(rest),
                    to_bytes(posed),
                    moved | mask if whole else mask,
                    signal.handles.astype(np.float32),
                    signal.targets.astype(np.float32),
                    asset.name,
                    view,
                    project_bones(asset.skeleton, signal.transforms, camera),
                )
        return None


def _seed(seed: int, *parts: Any) -> int:
    return int.from_bytes(hashlib.blake2b(repr((seed, *parts)).encode(), digest_size=8).digest(), "little")
