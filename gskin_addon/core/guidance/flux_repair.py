# SPDX-License-Identifier: GPL-3.0-or-later
"""Render and repair with FLUX.2 [klein], an image model that needs no fine-tuning.

The render posed with the current weights shows the right pose with torn seams; the model repaints it inside the
dynamic mask and sees the rest view as reference. It runs `Flux2KleinInpaintPipeline` of diffusers (>= 0.42) on
weights that the user brings. The usual ones, `black-forest-labs/FLUX.2-klein-4B`, are Apache-2.0 and distilled to
four steps; those of the 9B models are not for commercial use.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import consent
from .diffusion import (
    DiffusionGuidance,
    Frame,
    Tick,
    choose_offload,
    compute_device,
    device_memory,
    generator,
)
from .model_files import ModelFiles, check_numbers, find_model, first_line, require, stamp, too_many
from .options import FluxOptions, KleinOptions
from .provider import GuidanceContext

FILES = ModelFiles(
    role="FLUX.2 [klein] model",
    needs=(
        "model_index.json",
        "scheduler/scheduler_config.json",
        "transformer/config.json",
        ("transformer/*.safetensors", "transformer/*.safetensors.index.json"),
        "vae/config.json",
        "vae/*.safetensors",
        "text_encoder/config.json",
        ("text_encoder/*.safetensors", "text_encoder/*.safetensors.index.json"),
        ("tokenizer/tokenizer.json", "tokenizer/vocab.json"),
    ),
    licence="Apache-2.0",
    hub_id="black-forest-labs/FLUX.2-klein-4B",
    fetch=("model_index.json", "scheduler/*", "transformer/*", "vae/*", "text_encoder/*", "tokenizer/*"),
)

_PARTS = {
    "scheduler": "FlowMatchEulerDiscreteScheduler",
    "transformer": "Flux2Transformer2DModel",
    "vae": "AutoencoderKLFlux2",
    "text_encoder": "Qwen3ForCausalLM",
}
_PIPELINES = ("Flux2KleinPipeline", "Flux2KleinInpaintPipeline")

_UNUSED = ("lm_head.", "num_batches_tracked")
"""Tensors that play no part in painting, and may be missing."""

DISTILLED_STEPS, STEPS = 4, 50
RESIDENT, LARGEST = 13.0, 10.0
"""GiB of a GPU for the 4B transformer (7.8) and VAE with their work at 512 pixels, and for the transformer alone.
The text encoder (8.1) is loaded and freed before them."""
PER_FRAME = 2.0


class KleinPainter:
    """A loaded pipeline; the prompt is encoded once, and the text encoder dropped after it."""

    kind = "Flux2KleinPipeline"
    """The class of diffusers."""

    def __init__(self, folder: Path, options: KleinOptions) -> None:
        """Raises InputError for files that do not load."""
        import diffusers
        import transformers

        self._device, dtype = compute_device(options.device, options.dtype, half="bfloat16")
        self._options = options
        offload = choose_offload(options.offload, self._device, RESIDENT, LARGEST)
        spare = device_memory(self._device) - RESIDENT
        self.batch = options.batch or (int(np.clip(spare / PER_FRAME, 1, 4)) if np.isfinite(spare) else 1)
        how: dict[str, Any] = {"dtype": dtype, "use_safetensors": True, "local_files_only": True}
        try:
            # The text encoder and the transformer are never in memory together.
            kind: Any = getattr(diffusers, self.kind)
            parts = {
                "vae": _whole(diffusers.AutoencoderKLFlux2, folder, "vae", how),
                "text_encoder": _whole(transformers.Qwen3ForCausalLM, folder, "text_encoder", how),
            }
            self._pipeline = kind.from_pretrained(folder, transformer=None, **parts, **how)
            self._pipeline.set_progress_bar_config(disable=True)
            self._steps = options.steps or (DISTILLED_STEPS if self._pipeline.config.is_distilled else STEPS)
            self._prompt, self._empty = self._encode(offload)
            self._load_transformer(folder, how)
        except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
            raise InputError(
                f"The FLUX.2 [klein] model in '{folder}' does not load ({first_line(error)}); get its files again, "
                f"for example those of '{FILES.hub_id}'."
            ) from error
        if offload == "model":
            self._pipeline.enable_model_cpu_offload(device=self._device)
        elif offload == "sequential":
            self._pipeline.enable_sequential_cpu_offload(device=self._device)
        else:
            self._pipeline.to(self._device)

    def _encode(self, offload: str) -> tuple[Any, Any]:
        """Embeddings (1, 512, C) of the prompt and, where guidance needs it, of the empty one; on the device."""
        import torch

        pipeline, options = self._pipeline, self._options
        if offload == "sequential":
            from accelerate import cpu_offload

            cpu_offload(pipeline.text_encoder, self._device)
        else:
            pipeline.text_encoder.to(self._device)
        guided = options.guidance_scale > 1 and not pipeline.config.is_distilled
        with torch.no_grad():
            prompt, empty = (
                pipeline.encode_prompt(text, device=self._device)[0] if text is not None else None
                for text in (options.prompt.replace("{subject}", options.subject), "" if guided else None)
            )
        pipeline.register_modules(text_encoder=None, tokenizer=None)
        gc.collect()
        if self._device.type == "cuda":
            torch.cuda.empty_cache()
        return prompt, empty

    def _load_transformer(self, folder: Path, how: dict[str, Any]) -> None:
        import diffusers

        transformer = _whole(diffusers.Flux2Transformer2DModel, folder, "transformer", how)
        self._pipeline.register_modules(transformer=transformer.eval())


def _whole(kind: Any, folder: Path, part: str, how: Mapping[str, Any]) -> Any:
    """A model of the pipeline with every tensor from the file; the libraries make up what is missing.

    Raises:
        InputError: one is missing, too many or has another shape, or has numbers that are not finite.
    """
    model, report = kind.from_pretrained(folder, subfolder=part, output_loading_info=True, **how)
    for complaint, words in (("missing_keys", "lacks the tensor"), ("mismatched_keys", "has another shape of")):
        found = sorted(str(key) for key in report[complaint] if not any(name in str(key) for name in _UNUSED))
        if found:
            raise InputError(f"The {part} in '{folder}' {words} '{found[0]}'; get its files again.")
    found = [key for key in too_many(kind, report) if not any(name in key for name in _UNUSED)]
    if found:
        raise InputError(
            f"The config.json of the {part} in '{folder}' has no place for '{found[0]}'; get its files again."
        )
    check_numbers(f"The {part} in '{folder}'", model.named_parameters())
    return model


class FluxPainter(KleinPainter):
    """Repaints the posed render inside its mask."""

    kind = "Flux2KleinInpaintPipeline"

    def __init__(self, folder: Path, options: FluxOptions) -> None:
        """See KleinPainter."""
        super().__init__(folder, options)
        self._options: FluxOptions = options

    def paint(self, frames: Sequence[Frame], tick: Tick) -> Sequence[NDArray[Any]]:
        """See Painter."""
        count, size = len(frames), 2 * self._pipeline.vae_scale_factor
        height, width = frames[0].mask.shape

        def after_step(pipeline: Any, step: int, time: Any, tensors: dict[str, Any]) -> dict[str, Any]:
            tick((step + 1) / pipeline.num_timesteps)
            return {}

        painted = self._pipeline(
            image=np.stack([frame.posed for frame in frames]),
            mask_image=_torch_mask([whole_tokens(frame.mask, size) for frame in frames]),
            image_reference=np.stack([frame.rest for frame in frames]),
            prompt_embeds=self._prompt.expand(count, -1, -1),
            negative_prompt_embeds=None if self._empty is None else self._empty.expand(count, -1, -1),
            height=height,
            width=width,
            strength=self._options.strength,
            num_inference_steps=self._steps,
            guidance_scale=1.0 if self._empty is None else self._options.guidance_scale,
            generator=[generator(frame) for frame in frames],
            output_type="np",
            callback_on_step_end=after_step,
        )
        return list(painted.images)


def whole_tokens(mask: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """The mask (H, W) grown to whole tokens of `size` pixels: the model repaints a token wholly or not at all.

    What is painted beyond the mask is not kept, but the rim inside it would otherwise stay as it was.
    """
    height, width = mask.shape
    rows, columns = -(-height // size), -(-width // size)
    padded = np.zeros((rows * size, columns * size), bool)
    padded[:height, :width] = mask
    tokens = padded.reshape(rows, size, columns, size).any(axis=(1, 3))
    return tokens.repeat(size, axis=0).repeat(size, axis=1)[:height, :width]


def _torch_mask(masks: list[NDArray[np.bool_]]) -> Any:
    import torch

    return torch.from_numpy(np.stack(masks)[:, None].astype(np.float32))


def check_index(folder: Path) -> None:
    """Raise InputError unless model_index.json describes a FLUX.2 [klein] pipeline and no code of its own."""
    path = folder / "model_index.json"
    try:
        index: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        name = index["_class_name"]
        parts = {part: index[part][1] for part in _PARTS}
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"'{path}' does not describe a diffusers pipeline ({error}); name a FLUX.2 [klein] model such as "
            f"'{FILES.hub_id}'."
        ) from None
    wrong = [f"{part} {given}" for part, given in parts.items() if given != _PARTS[part]]
    if name not in _PIPELINES or wrong:
        raise InputError(
            f"'{folder}' holds a {wrong[0] if name in _PIPELINES else name}, not a FLUX.2 [klein] pipeline; name one "
            f"such as '{FILES.hub_id}' (licence: {FILES.licence})."
        )


def find_klein(model: str, who: str, *, allow_download: bool, tell: Callable[[str], None]) -> Path:
    """The folder of a FLUX.2 [klein] pipeline, checked by its names; `who` needs it.

    Raises:
        InputError: packages or files that are not right. GSkinError: a download that failed.
    """
    require("diffusers", who)
    require("transformers", who)
    folder = find_model(model, FILES, allow_download=allow_download, tell=tell)
    check_index(folder)
    return folder


def create(context: GuidanceContext) -> DiffusionGuidance:
    """The provider for `context`; finds and checks the files, and loads them when the first image is made.

    Raises:
        InputError: options, packages or files that are not right. GSkinError: a download that failed.
    """
    options = FluxOptions.parse(context.options, "flux_repair")
    folder = find_klein(
        options.model,
        "The guidance 'flux_repair'",
        allow_download=consent.is_given(),
        tell=lambda message: context.tick(0.0, message),
    )
    _, dtype = compute_device(options.device, options.dtype, half="bfloat16")
    identity = {"provider": "flux_repair", **options.identity(), "dtype": str(dtype), "files": stamp(folder)}

    def load() -> FluxPainter:
        context.tick(0.0, "Loading FLUX.2 [klein]")
        return FluxPainter(folder, options)

    return DiffusionGuidance(context, load, identity)
