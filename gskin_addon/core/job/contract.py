# SPDX-License-Identifier: GPL-3.0-or-later
"""The job folder: what is asked of a worker, and what it answers. numpy and the standard library only.

asked:
    job.json        {"version": 1, "settings": {...}, "fingerprint": "..."}; written last of the three
    splats.npz      means (N,3), quats (N,4) wxyz, scales (N,3) linear, opacities (N,), sh (N,K,3); world
    skeleton.json   deform bones, world space (Skeleton.to_json)
answered:
    weights.npz     weights (N,B) float32, rows sum to 1; bones (B,), heads (B,3), tails (B,3), parents (B,);
                    with a proxy mesh also mesh_weights (V,B) of its vertices; where known also confidence (N,),
                    and start_bones, start_weights (N,K): what was there before learning
    previews/*.png  pictures of the result
    report.json     what was done and measured; written last, so a folder with it is finished
meanwhile:
    checkpoint/     the pipeline's own
    worker.lock     held while a worker runs
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import disk_error, is_plain_name, read_arrays, write_arrays, write_json, write_png, write_text
from ..guidance.options import deciding
from ..rig.influences import Influences
from ..rig.skeleton import Skeleton
from ..rig.weights_file import read_weights_file, write_weights_file
from ..splats.cloud import SplatCloud
from .checks import check_inputs

VERSION = 1
JOB, SPLATS, SKELETON = "job.json", "splats.npz", "skeleton.json"
WEIGHTS, REPORT, PREVIEWS = "weights.npz", "report.json", "previews"
CHECKPOINT, LOCK = "checkpoint", "worker.lock"

_CLOUD_ARRAYS = ("means", "quats", "scales", "opacities", "sh")


@dataclass(frozen=True)
class Job:
    """A job folder read back: settings by name, splats and skeleton in the same world space."""

    folder: Path
    settings: dict[str, Any]
    cloud: SplatCloud
    skeleton: Skeleton
    fingerprint: str

    @property
    def checkpoint(self) -> Path:
        """The folder in which the pipeline keeps what it needs to go on after a stop."""
        return self.folder / CHECKPOINT


@dataclass(frozen=True)
class Result:
    """What a finished job holds.

    weights: (N, B) float32, one row per splat in the job's order, rows sum to 1.
    bones: B names; heads, tails: (B, 3) metres, world space; parents: (B,) index, -1 for a root.
    report: numbers and words of report.json; previews: picture files by name.
    mesh_weights: (V, B) float32 of the proxy mesh's vertices, where the job had one.
    confidence: (N,) float32 in 0..1, how sure the weights of each splat are, where the method knows.
    start: what the weights were before learning, where there was any; the report says under "start" what they are.
    """

    weights: NDArray[np.float32]
    bones: tuple[str, ...]
    heads: NDArray[np.float64]
    tails: NDArray[np.float64]
    parents: NDArray[np.int64]
    report: dict[str, Any]
    previews: dict[str, Path]
    mesh_weights: NDArray[np.float32] | None = None
    confidence: NDArray[np.float32] | None = None
    start: Influences | None = None


@dataclass(frozen=True)
class PreparedJob:
    """A job that was checked and may be written: see `prepare_job`.

    fingerprint: 32 hexadecimal digits that are the same for the same job, a name for its folder.
    """

    cloud: SplatCloud
    skeleton: Skeleton
    settings: dict[str, Any]
    fingerprint: str
    files: Mapping[str, Mapping[str, NDArray[Any]]]

    def write(self, folder: str | Path) -> Path:
        """Make `folder` (created where missing) this job and return it.

        The very same job written again keeps its checkpoint and result, so that a stopped one goes on; another
        job in the same folder starts clean.

        Raises:
            GSkinError: the folder cannot be written.
        """
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if _fingerprint_in(folder) != self.fingerprint:
                clear_results(folder)
                (folder / JOB).unlink(missing_ok=True)
        except OSError as error:
            raise disk_error(error, folder) from error
        for name, arrays in self.files.items():
            write_arrays(folder / name, arrays)
        write_arrays(folder / SPLATS, _cloud_arrays(self.cloud))
        write_text(folder / SKELETON, self.skeleton.to_json() + "\n")
        write_json(
            folder / JOB, {"version": VERSION, "settings": self.settings, "fingerprint": self.fingerprint}
        )
        return folder


def prepare_job(
    cloud: SplatCloud,
    skeleton: Skeleton,
    settings: Mapping[str, Any],
    *,
    files: Mapping[str, Mapping[str, NDArray[Any]]] | None = None,
    splats: str = "The splats",
    armature: str = "The armature",
    up: str = "z",
) -> PreparedJob:
    """Check a job once, and find out what it is called, before anything is written.

    files: further .npz files of the job by plain name, which its settings speak of (see `mesh_file`); their names must
    tell their contents apart, since the fingerprint knows the names only. `splats`, `armature` and `up` word the
    messages (see `check_inputs`).

    Raises:
        InputError: the splats or bones cannot be skinned; settings that JSON cannot hold.
    """
    check_inputs(cloud, skeleton, splats=splats, armature=armature, up=up)
    files = dict(files or {})
    own = (JOB, SPLATS, SKELETON, WEIGHTS, REPORT, PREVIEWS, CHECKPOINT, LOCK)
    for name in files:
        if not is_plain_name(name) or name in own:
            raise ValueError(f"'{name}' is no name for a further file of a job")
    return PreparedJob(cloud, skeleton, dict(settings), fingerprint(cloud, skeleton, settings), files)


def write_job(
    folder: str | Path,
    cloud: SplatCloud,
    skeleton: Skeleton,
    settings: Mapping[str, Any],
    *,
    splats: str = "The splats",
    armature: str = "The armature",
    up: str = "z",
) -> Path:
    """`prepare_job` and `PreparedJob.write` in one, for those who have a folder.

    Raises: as these.
    """
    return prepare_job(cloud, skeleton, settings, splats=splats, armature=armature, up=up).write(folder)


def fingerprint(cloud: SplatCloud, skeleton: Skeleton, settings: Mapping[str, Any]) -> str:
    """32 hexadecimal digits that are the same for the same job.

    Raises:
        InputError: settings that JSON cannot hold.
    """
    try:
        json.dumps(dict(settings), allow_nan=False, ensure_ascii=False).encode()
        canonical = json.dumps(deciding(settings), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"The job's settings must be plain numbers, words and lists ({error}).") from None
    digest = hashlib.blake2b(digest_size=16)
    digest.update(f"{VERSION}\n{canonical}\n{skeleton.to_json()}\n".encode())
    for name, array in _cloud_arrays(cloud).items():
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode())
        digest.update(memoryview(array).cast("B") if array.size else b"")
    return digest.hexdigest()


def read_job(folder: str | Path) -> Job:
    """Read the job in `folder`.

    Raises:
        InputError: a file is missing or is not what the contract says, or a newer gskin wrote it.
    """
    folder = Path(folder)
    head = _read_json(folder / JOB)
    version = head.get("version")
    if type(version) is not int or version != VERSION:
        named = f"version {version}" if isinstance(version, int) else "no version that is a number"
        raise InputError(
            f"'{folder / JOB}' has {named}, this gskin reads version {VERSION}; "
            "write the job with the same gskin that runs it."
        )
    settings = head.get("settings", {})
    if not isinstance(settings, dict):
        raise InputError(
            f"'{folder / JOB}' has settings that are not a table of names and values; correct it."
        )
    arrays = _read_arrays(folder / SPLATS, _CLOUD_ARRAYS)
    try:
        cloud = SplatCloud(**{name: arrays[name] for name in _CLOUD_ARRAYS})  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise InputError(
            f"'{folder / SPLATS}' does not hold splats ({error}); write the job again."
        ) from None
    skeleton_file = folder / SKELETON
    skeleton = Skeleton.from_json(_read_text(skeleton_file), label=f"'{skeleton_file}'")
    check_inputs(cloud, skeleton, splats=f"'{folder / SPLATS}'", armature=f"'{skeleton_file}'")
    found = head.get("fingerprint")
    return Job(folder, settings, cloud, skeleton, found if isinstance(found, str) else "")


def write_result(
    job: Job,
    weights: NDArray[Any],
    report: Mapping[str, Any],
    previews: Mapping[str, NDArray[Any]],
    mesh_weights: NDArray[Any] | None = None,
    confidence: NDArray[Any] | None = None,
    start: Influences | None = None,
) -> None:
    """Write a job's answer: weights, pictures by name ((H, W, 3) in 0..1), and the report last of all."""
    if len(weights) != job.cloud.count:
        raise ValueError(f"{len(weights)} rows of weights for {job.cloud.count} splats")
    write_weights_file(job.folder / WEIGHTS, weights, job.skeleton, mesh_weights, confidence, start)
    pictures = job.folder / PREVIEWS
    try:
        pictures.mkdir(exist_ok=True)
    except OSError as error:
        raise disk_error(error, pictures) from error
    for name, image in previews.items():
        write_png(pictures / f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)}.png", image)
    write_json(job.folder / REPORT, _plain(report))


def read_result(folder: str | Path) -> Result:
    """Read what the worker left in `folder`.

    Raises:
        InputError: the job is not finished, or its files are damaged.
    """
    folder = Path(folder)
    if not is_finished(folder):
        raise InputError(f"The job in '{folder}' is not finished; run it (again) and wait for its end.")
    weights = read_weights_file(folder / WEIGHTS)
    previews = {path.stem: path for path in sorted((folder / PREVIEWS).glob("*.png"))}
    return Result(**vars(weights), report=_read_json(folder / REPORT), previews=previews)


def is_finished(folder: str | Path) -> bool:
    """Whether the worker has done the job in `folder` to the end."""
    return (Path(folder) / REPORT).is_file() and (Path(folder) / WEIGHTS).is_file()


def clear_results(folder: str | Path) -> None:
    """Remove result and checkpoint of the job in `folder`; does nothing to a folder that is no job."""
    folder = Path(folder)
    if not (folder / JOB).is_file():
        return
    for name in (REPORT, WEIGHTS):  # the report first: without it nothing passes for finished
        (folder / name).unlink(missing_ok=True)
    for name in (PREVIEWS, CHECKPOINT):
        shutil.rmtree(folder / name, ignore_errors=True)


def _cloud_arrays(cloud: SplatCloud) -> dict[str, NDArray[Any]]:
    return {name: np.ascontiguousarray(getattr(cloud, name)) for name in _CLOUD_ARRAYS}


def _fingerprint_in(folder: Path) -> str | None:
    try:
        found = json.loads((folder / JOB).read_text(encoding="utf-8")).get("fingerprint")
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    return found if isinstance(found, str) else None


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(
            f"'{path}' is missing; '{path.parent}' is not a whole job, write it again."
        ) from None
    except OSError as error:
        raise InputError(
            f"'{path}' cannot be read ({error.strerror}); check the folder's permissions."
        ) from None
    except ValueError:
        raise InputError(f"'{path}' is not UTF-8 text; write the job again.") from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(_read_text(path), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"'{path}' is not valid JSON ({error}); write the job again.") from None
    if not isinstance(value, dict):
        raise InputError(f"'{path}' does not hold a table of names and values; write the job again.")
    return value


def _refuse_constant(name: str) -> None:
    """Python's reader takes NaN and Infinity, which are no JSON."""
    raise ValueError(f"{name} is no number")


def _read_arrays(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    try:
        return read_arrays(path, names)
    except FileNotFoundError:
        raise InputError(
            f"'{path}' is missing; '{path.parent}' is not a whole job, write it again."
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(
            f"'{path}' is damaged or not an .npz of numbers ({error}); write it again."
        ) from None


def _plain(value: Any) -> Any:
    """numpy scalars and arrays as JSON's numbers and lists; a number that is not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.generic,)):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
