# SPDX-License-Identifier: GPL-3.0-or-later
"""The run of every diffusion provider: renders and masks in, composited images out, resumable image by image.

A provider gives a `Painter`; this loop gives it frames of one view at a time, keeps what is outside the painting
mask, saves each finished image in the job's checkpoint folder, and checks after every denoising step whether the user
wants to stop.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import GSkinError, InputError
from ..files import write_png
from ..render.rasterizer import render_cloud
from ..rig.lbs import skin_cloud
from .control import ControlSignal
from .mask import MASK_VERSION, painting_mask
from .provider import GuidanceContext, to_bytes
from .skeleton_image import DrawnBones, project_bones

if TYPE_CHECKING:
    import torch

Tick = Callable[[float], None]
"""Called with the done part (0 to 1) of the batch after each denoising step; raises Cancelled."""


@dataclass(frozen=True)
class Frame:
    """What a painter sees of one guidance image.

    rest, posed (H, W, 3) float32 in [0, 1]: renders at rest, and posed with the current weights; mask (H, W) bool:
    where it may paint; seed: of all randomness of this image; bones: the skeleton as the view sees it, None where
    it is not known.
    """

    signal: ControlSignal
    rest: NDArray[np.float32]
    posed: NDArray[np.float32]
    mask: NDArray[np.bool_]
    seed: int
    bones: DrawnBones | None = None


class Painter(Protocol):
    """A loaded model."""

    @property
    def batch(self) -> int:
        """How many frames it takes at once."""

    def paint(self, frames: Sequence[Frame], tick: Tick) -> Sequence[NDArray[Any]]:
        """One image (H, W, 3) in [0, 1] or uint8 per frame. The frames are at most `batch`, all of one view.

        An image depends on its own frame only, not on the others in the batch.
        """


class DiffusionGuidance:
    """Guidance images from a painter, which is loaded when the first image is needed that is not saved yet."""

    def __init__(
        self, context: GuidanceContext, load: Callable[[], Painter], identity: Mapping[str, Any]
    ) -> None:
        """identity: plain values that, with the job, decide the pictures: settings and names of the models."""
        self._context, self._load = context, load
        self._painter: Painter | None = None
        self._rest: dict[int, NDArray[np.float32]] = {}
        self._identity = _digest(identity, context)
        self._done = self._total = 0

    def images(self, signals: Sequence[ControlSignal]) -> Iterator[NDArray[np.uint8]]:
        """See Provider. What an earlier run of the same job has saved is taken from there."""
        ready: dict[int, NDArray[np.uint8]] = {}
        self._total = len(signals)
        for number, signal in enumerate(signals):
            self._done = number
            saved = ready.pop(number, None)
            if saved is None:
                saved = self._saved(number, signal)
            if saved is None:
                batch = self._batch_from(number, signals)
                ready = self._paint(batch, signals)
                saved = ready.pop(number)
            yield saved

    def _batch_from(self, first: int, signals: Sequence[ControlSignal]) -> list[int]:
        """Numbers of the next images that are not saved, `first` among them, all of its view."""
        self._tell(0.0)
        if self._painter is None:
            self._painter = self._load()
        numbers = [first]
        for number in range(first + 1, len(signals)):
            if len(numbers) == self._painter.batch or signals[number].view != signals[first].view:
                break
            if not self._saved_at(number, signals[number]).is_file():
                numbers.append(number)
        return numbers

    def _paint(self, numbers: list[int], signals: Sequence[ControlSignal]) -> dict[int, NDArray[np.uint8]]:
        frames = {number: self._frame(number, signals[number]) for number in numbers}
        to_paint = [number for number in numbers if frames[number].mask.any()]
        finished = {
            number: to_bytes(frame.rest) for number, frame in frames.items() if not frame.mask.any()
        }  # nothing moved far enough to be seen
        if to_paint:
            assert self._painter is not None
            painted = self._painter.paint(
                [frames[number] for number in to_paint], lambda done: self._tell(done * len(to_paint))
            )
            for number, image in zip(to_paint, painted, strict=True):
                finished[number] = composite(frames[number], image)
        for number, image in finished.items():
            path = self._saved_at(number, signals[number])
            if self._context.checkpoint is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_png(path, image)
        return finished

    def _frame(self, number: int, signal: ControlSignal) -> Frame:
        context = self._context
        if signal.view not in self._rest:
            self._rest = {signal.view: render_cloud(context.cloud, signal.camera, context.background)[0]}
        rest = self._rest[signal.view]
        moved = skin_cloud(context.cloud, context.initial, signal.transforms, rotate_sh=False)
        posed = render_cloud(moved, signal.camera, context.background)[0]
        mask = painting_mask(rest, posed, signal.handles, signal.targets)
        bones = project_bones(context.skeleton, signal.transforms, signal.camera)
        return Frame(signal, rest, posed, mask, image_seed(context.seed, number), bones)

    def _saved_at(self, number: int, signal: ControlSignal) -> Path:
        folder = self._context.checkpoint or Path()
        return folder / "guidance" / f"{_signal_key(self._identity, number, signal)}.png"

    def _saved(self, number: int, signal: ControlSignal) -> NDArray[np.uint8] | None:
        path = self._saved_at(number, signal)
        if self._context.checkpoint is None or not path.is_file():
            return None
        from PIL import Image

        try:
            # PNG only: for some formats Pillow starts other programs.
            with Image.open(path, formats=["PNG"]) as picture:
                if picture.size[::-1] != signal.camera.size:
                    return None
                image = np.array(picture.convert("RGB"))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):  # what PIL says of a damaged PNG
            return None
        return image if image.shape[:2] == signal.camera.size else None

    def _tell(self, images: float) -> None:
        done = min(self._done + images, float(self._total))
        self._context.tick(done / max(self._total, 1), f"Guidance image {self._done + 1} of {self._total}")


def composite(frame: Frame, image: NDArray[Any]) -> NDArray[np.uint8]:
    """`image` (H, W, 3), in [0, 1] or uint8, inside the painting mask, the rest view outside.

    Raises:
        GSkinError: the image has values that are not finite, as half precision gives on some cards.
    """
    painted = np.asarray(image)
    if painted.shape != frame.rest.shape:
        raise ValueError(f"the model gave an image {painted.shape} for one of {frame.rest.shape}")
    if painted.dtype != np.uint8:
        if not np.isfinite(painted).all():
            raise GSkinError(
                "The guidance model gave no picture but values that are not numbers; choose another dtype in its "
                "options (bfloat16 or float32)."
            )
        painted = to_bytes(painted)
    return np.where(frame.mask[..., None], painted, to_bytes(frame.rest))


def image_seed(seed: int, number: int) -> int:
    """The seed of image `number` of a job, the same in whatever batch it is made."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def noise(frame: Frame, shape: Sequence[int]) -> torch.Tensor:
    """Standard normal float32 noise of `shape` for a frame; made on the CPU, so that every device gets the same."""
    import torch

    return torch.randn(tuple(shape), generator=generator(frame))


def generator(frame: Frame) -> torch.Generator:
    """A torch generator on the CPU, fresh from the frame's seed."""
    import torch

    return torch.Generator("cpu").manual_seed(frame.seed)


def compute_device(device: str, dtype: str, half: str = "float16") -> tuple[torch.device, torch.dtype]:
    """The torch device and type of weights that "auto" or a name stand for; `half`: the type on a GPU.

    Raises:
        InputError: there is no such device here.
    """
    import torch

    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    try:
        chosen = torch.device(device)
        torch.zeros(1, device=chosen)
    except (RuntimeError, AssertionError) as error:
        why = str(error).strip().split("\n")[0]
        raise InputError(f"The device '{device}' cannot be used ({why}); choose auto or cpu.") from None
    name = ("float32" if chosen.type == "cpu" else half) if dtype == "auto" else dtype
    return chosen, getattr(torch, name)


def device_memory(device: torch.device) -> float:
    """GiB of memory of a CUDA device; infinite elsewhere, where weights have nowhere else to go."""
    import torch

    if device.type != "cuda":
        return float("inf")
    return torch.cuda.get_device_properties(device).total_memory / 2**30


def choose_offload(offload: str, device: torch.device, resident: float, largest: float) -> str:
    """What "auto" stands for: resident and largest are GiB of all weights, and of the largest model with its work.

    Off the GPU there is nothing to off-load.
    """
    if device.type != "cuda":
        return "none"
    if offload != "auto":
        return offload
    memory = device_memory(device)
    return "none" if memory > resident else "model" if memory > largest else "sequential"


def _digest(identity: Mapping[str, Any], context: GuidanceContext) -> bytes:
    """Everything that an image depends on, except its own signal."""
    digest = hashlib.blake2b(digest_size=16)
    known = {"mask": MASK_VERSION, "seed": context.seed, "background": list(context.background), **identity}
    digest.update(json.dumps(known, sort_keys=True).encode())
    cloud = context.cloud
    for array in (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh, context.initial):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


def _signal_key(identity: bytes, number: int, signal: ControlSignal) -> str:
    digest = hashlib.blake2b(identity, digest_size=16)
    digest.update(f"{number} {signal.view}".encode())
    camera = asdict(signal.camera)
    for value in (*camera.values(), signal.transforms, signal.handles, signal.targets):
        digest.update(np.asarray(value, np.float64).tobytes())
    return digest.hexdigest()
