# SPDX-License-Identifier: GPL-3.0-or-later
"""FLUX.2 [klein] with the rest view and two drawn skeletons as reference images, at rest and posed.

It runs `Flux2KleinPipeline` of diffusers (>= 0.42), which takes any number of reference images. The model knows
nothing of our skeletons by itself; `train-guidance tune --model flux2` teaches it by a LoRA. Outside the painting mask
the tokens are held at the rest view in each step, as the library's inpainting does (Lugmayr et al. 2022, Eq. 8).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import consent
from .diffusion import DiffusionGuidance, Frame, Tick, compute_device, noise
from .flux_repair import KleinPainter, find_klein, whole_tokens
from .model_files import first_line, load_tensors, require, stamp
from .options import Flux2Options
from .provider import GuidanceContext, to_bytes
from .skeleton_image import DRAWING_VERSION, DrawnBones, draw_bones

LORA = "pytorch_lora_weights.safetensors"
"""The usual name in the layout of diffusers."""

ADAPTER = "default"

SMALLEST = 64
"""Pixels of the side of a reference image that the pipeline takes."""


class Flux2Painter(KleinPainter):
    """Draws the posed picture from noise; one frame after the other, since all references are of one image."""

    def __init__(self, folder: Path, options: Flux2Options) -> None:
        """Raises InputError for files that do not load."""
        self._lora = Path(options.lora).expanduser() if options.lora.strip() else None
        super().__init__(folder, options)
        self.batch = 1

    @property
    def pipeline(self) -> Any:
        """The pipeline of diffusers, for training."""
        return self._pipeline

    @property
    def prompt(self) -> Any:
        """The embeddings (1, T, C) of the prompt."""
        return self._prompt

    def paint(self, frames: Sequence[Frame], tick: Tick) -> Sequence[NDArray[Any]]:
        """See Painter."""
        images = []
        for number, frame in enumerate(frames):

            def part(done: float, number: int = number) -> None:
                tick((number + done) / len(frames))

            images.append(self._draw(frame, part))
        return images

    def _draw(self, frame: Frame, tick: Tick) -> NDArray[Any]:
        import torch
        from PIL import Image

        pipeline, size = self._pipeline, self.token
        height, width = frame.mask.shape
        check_size((height, width), size)
        pictures = references(to_bytes(frame.rest), frame.bones)
        rest, _ = self.tokens(pictures[:1])
        device = pipeline._execution_device
        rows, columns = height // size, width // size
        start = noise(frame, (1, rest.shape[2], rows, columns)).to(device, self._prompt.dtype)
        packed = start.flatten(2).transpose(1, 2)
        inside = whole_tokens(frame.mask, size)[::size, ::size]
        keep = torch.from_numpy(~inside).reshape(1, -1, 1).to(device)

        def after_step(pipe: Any, step: int, time: Any, tensors: dict[str, Any]) -> dict[str, Any]:
            tick((step + 1) / pipe.num_timesteps)
            sigma = pipe.scheduler.sigmas[step + 1].to(device, packed.dtype)
            known = (1 - sigma) * rest.to(packed.dtype) + sigma * packed
            return {"latents": torch.where(keep, known, tensors["latents"])}

        painted = pipeline(
            image=[Image.fromarray(picture) for picture in pictures],
            prompt_embeds=self._prompt,
            negative_prompt_embeds=self._empty,
            latents=start,
            height=height,
            width=width,
            num_inference_steps=self._steps,
            guidance_scale=1.0 if self._empty is None else self._options.guidance_scale,
            output_type="np",
            callback_on_step_end=after_step,
        )
        image: NDArray[Any] = painted.images[0]
        return image

    @property
    def token(self) -> int:
        """Pixels of a token's side."""
        return 2 * int(self._pipeline.vae_scale_factor)

    def tokens(self, pictures: Sequence[NDArray[np.uint8]]) -> tuple[Any, Any]:
        """Normalised latents (1, T, C) of reference images (H, W, 3) and their positions (1, T, 4), in a row."""
        import torch
        from PIL import Image

        pipeline = self._pipeline
        with torch.no_grad():
            images = [pipeline.image_processor.preprocess(Image.fromarray(picture)) for picture in pictures]
            latents, places = pipeline.prepare_image_latents(
                images, 1, None, pipeline._execution_device, pipeline.vae.dtype
            )
        return latents, places

    def _load_transformer(self, folder: Path, how: dict[str, Any]) -> None:
        super()._load_transformer(folder, how)
        if self._lora is not None:
            load_lora(self._pipeline, self._lora)


def check_size(size: tuple[int, int], token: int) -> None:
    """Raise InputError unless images of `size` (height, width) can be references, in whole tokens of `token` pixels."""
    if size[0] % token or size[1] % token or min(size) < SMALLEST:
        raise InputError(
            f"FLUX.2 [klein] cannot paint images of {size[1]} x {size[0]} pixels; take multiples of {token} from "
            f"{SMALLEST} on."
        )


def references(rest: NDArray[np.uint8], bones: DrawnBones | None) -> list[NDArray[np.uint8]]:
    """The reference images (H, W, 3) of a frame: the rest view, the skeleton at rest, the skeleton posed.

    Raises:
        InputError: the bones are not known.
    """
    if bones is None:
        raise InputError(
            "These image pairs hold no skeletons, as pairs of an older gskin do; make them again with "
            "train-guidance pairs in another folder."
        )
    size = (rest.shape[0], rest.shape[1])
    return [rest, draw_bones(bones.rest, bones.bone, size), draw_bones(bones.posed, bones.bone, size)]


def find_lora(name: str) -> Path:
    """The folder of a LoRA. Raises InputError where there is none."""
    require("peft", "A LoRA for FLUX.2 [klein]")
    folder = Path(name).expanduser()
    if not (folder / LORA).is_file():
        raise InputError(
            f"The LoRA '{folder / LORA}' does not exist; name the folder that train-guidance tune --model flux2 wrote."
        )
    return folder


def load_lora(pipeline: Any, folder: Path) -> None:
    """Put the LoRA in `folder` on the pipeline's transformer.

    Raises:
        InputError: it is damaged, or does not fit this model; names file and tensor.
    """
    from peft import get_peft_model_state_dict

    path = folder / LORA
    state = load_tensors(path, "LoRA")
    if not state:
        raise InputError(f"The LoRA '{path}' is empty; get the file again.")
    wrong = [key for key in state if not key.startswith("transformer.") or ".lora_" not in key]
    if wrong:
        raise InputError(f"The LoRA '{path}' has a tensor '{wrong[0]}' of another model; get the right file.")
    try:
        pipeline.load_lora_weights(dict(state), adapter_name=ADAPTER)
    except Exception as error:  # of diffusers, of peft, of torch
        raise InputError(
            f"The LoRA '{path}' does not fit this FLUX.2 [klein] model ({first_line(error)}); choose files that belong "
            "together."
        ) from error
    own = get_peft_model_state_dict(pipeline.transformer, adapter_name=ADAPTER)
    given = {key.removeprefix("transformer.") for key in state}
    strange = [*sorted(given - set(own)), *sorted(set(own) - given)]
    if strange:
        raise InputError(
            f"The LoRA '{path}' does not fit this FLUX.2 [klein] model at '{strange[0]}'; choose files that belong "
            "together."
        )


def create(context: GuidanceContext) -> DiffusionGuidance:
    """The provider for `context`; finds and checks the files, and loads them when the first image is made.

    Raises:
        InputError: options, packages or files that are not right. GSkinError: a download that failed.
    """
    options = Flux2Options.parse(context.options, "flux2")
    folder = find_klein(
        options.model,
        "The guidance 'flux2'",
        allow_download=consent.is_given(),
        tell=lambda message: context.tick(0.0, message),
    )
    lora = find_lora(options.lora) if options.lora.strip() else None
    _, dtype = compute_device(options.device, options.dtype, half="bfloat16")
    identity = {
        "provider": "flux2",
        **options.identity(),
        "dtype": str(dtype),
        "files": stamp(folder),
        "lora_file": stamp(lora, (LORA,)) if lora is not None else [],
        "drawing": DRAWING_VERSION,
        "skeleton": hashlib.blake2b(context.skeleton.to_json().encode(), digest_size=8).hexdigest(),
    }

    def load() -> Flux2Painter:
        context.tick(0.0, "Loading FLUX.2 [klein]")
        return Flux2Painter(folder, options)

    return DiffusionGuidance(context, load, identity)
