# SPDX-License-Identifier: GPL-3.0-or-later
"""Loading the models of LightningDrag, and refusing files that are not theirs by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ...errors import InputError
from ..model_files import check_numbers, check_pickle_reader, first_line, load_tensors, too_many
from .appearance import absent_keys, prune
from .files import APPEARANCE, ATTENTION, POINTS, Files, read_table
from .image_tokens import ImageTokens
from .lora import merge_lora
from .point_embedding import PointEmbedding, width_of
from .processors import install, self_attentions
from .schedule import FIRST_TIMESTEP, Schedule

SCALING = 0.18215
"""Of the latents of Stable Diffusion 1.5; SDXL's VAE has the same tensors and other latents, scaled by 0.13025."""


@dataclass
class LightningDrag:
    """All models, in evaluation mode and without gradients.

    unet: the denoising UNet, whose attention processors are also in `processors`, in the published order;
    appearance: the pruned appearance encoder; text (1, 77, width): the empty prompt; places: the self-attentions'
    names in the order of the bank; scheduler: the base model's configuration.
    """

    unet: Any
    processors: nn.ModuleList
    point_embedding: PointEmbedding
    appearance: Any
    image_encoder: Any
    image_tokens: ImageTokens
    vae: Any
    text: torch.Tensor
    places: list[str]
    scheduler: dict[str, Any]

    @property
    def encoders(self) -> tuple[nn.Module, ...]:
        """What is needed once per view only."""
        return (self.appearance, self.image_encoder, self.image_tokens)

    @property
    def denoisers(self) -> tuple[nn.Module, ...]:
        """What is needed for every image."""
        return (self.unet, self.point_embedding, self.vae)


def load(files: Files, dtype: torch.dtype, trained: torch.dtype | None = None) -> LightningDrag:
    """Load everything to the CPU as `dtype`; what fine-tuning changes as `trained`, where that is given.

    Raises:
        InputError: a file is damaged, or holds the weights of something else.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPVisionModelWithProjection

    _quiet()
    trained = trained or dtype
    scheduler = _scheduler(files.base / "scheduler/scheduler_config.json")
    unet = _pretrained(UNet2DConditionModel, files.base / "unet", "base model's UNet", torch_dtype=dtype)
    if files.lcm_lora is not None:
        path = files.lcm_lora / "pytorch_lora_weights.safetensors"
        merge_lora(unet, load_tensors(path, "LCM-LoRA"), f"The LCM-LoRA '{path}'")
    points = load_point_embedding(files.lightning_drag / POINTS).to(trained)
    processors = install(unet, points.embeddings)
    for number, processor in enumerate(processors):
        processor.to(dtype if number % 2 else trained)
    folder = files.ip_adapter / "models/image_encoder"
    encoder = _pretrained(CLIPVisionModelWithProjection, folder, "image encoder", dtype=dtype)
    adapter = read_ip_adapter(_ip_adapter_file(files.ip_adapter), processors)
    tokens = load_image_tokens(adapter, encoder.config.projection_dim, unet.config.cross_attention_dim).to(dtype)
    load_attention(files.lightning_drag / ATTENTION, processors, adapter)
    appearance = load_appearance(files.lightning_drag / APPEARANCE, unet.config, trained)
    vae = _pretrained(AutoencoderKL, files.vae, "VAE", torch_dtype=dtype)
    _check_vae(vae.config, files.vae)
    vae.enable_slicing()
    model = LightningDrag(
        unet=unet,
        processors=processors,
        point_embedding=points,
        appearance=appearance,
        image_encoder=encoder,
        image_tokens=tokens,
        vae=vae,
        text=empty_prompt(files.base, unet.config.cross_attention_dim),
        places=self_attentions(unet),
        scheduler=scheduler,
    )
    for module in (*model.encoders, *model.denoisers):
        module.eval().requires_grad_(False)
    return model


def load_strictly(module: nn.Module, state: Mapping[str, Any], what: str) -> None:
    """Load all of `state` into all of `module`. Raises InputError naming the first tensor that does not fit."""
    check_tensors(module, state, what)
    module.load_state_dict(dict(state))


def check_tensors(module: nn.Module, state: Mapping[str, Any], what: str) -> None:
    """Raise InputError unless `state` has every tensor of `module`, in its shape, and no other; `what`: the file."""
    own = module.state_dict()
    for key, tensor in own.items():
        given = state.get(key)
        if not isinstance(given, torch.Tensor):
            raise InputError(f"{what} lacks the tensor '{key}'; get the right file.")
        if given.shape != tensor.shape:
            raise InputError(
                f"{what} has '{key}' as {tuple(given.shape)}, but the other models need {tuple(tensor.shape)}; "
                "choose files that belong together."
            )
    extra = sorted(set(state) - set(own))
    if extra:
        raise InputError(f"{what} has a tensor '{extra[0]}' that does not belong there; get the right file.")


def load_point_embedding(path: Path) -> PointEmbedding:
    """The point embedding of a file with its thirteen tensors."""
    state = load_tensors(path, "point embedding")
    points = PointEmbedding(width_of(state))
    load_strictly(points, state, f"The point embedding '{path}'")
    return points


def load_attention(path: Path, processors: nn.ModuleList, adapter: IPAdapter) -> None:
    """Load the attention weights of `path` into all of `processors`, with the IP-Adapter's in place of its own.

    The file may hold the self-attentions' tensors only (48 of 80, the published 5.6 M parameters) or all: the
    adapter's are merged into them first, and what comes of it must fit strictly, as in the original.

    Raises:
        InputError: it lacks a tensor, or has one of another shape or model.
    """
    own = load_tensors(path, "attention weights")
    load_strictly(processors, {**own, **adapter.cross}, f"The attention weights '{path}'")


def load_appearance(folder: Path, base: Mapping[str, Any], dtype: torch.dtype) -> Any:
    """The appearance encoder in `folder` as `dtype`, pruned to what its checkpoint holds.

    It is built from `base`, the configuration of the denoising UNet, with four channels; a config.json beside the
    weights is not read (the original reads none either).

    Raises:
        InputError: its tensors are not exactly the stock UNet's without `absent_keys`.
    """
    from diffusers import UNet2DConditionModel

    path = folder / "diffusion_pytorch_model.safetensors"
    what = f"The appearance encoder '{path}'"
    stock: Any = UNet2DConditionModel
    with torch.device("meta"):
        unet = stock.from_config({**base, "in_channels": 4})
    state = load_tensors(path, "appearance encoder")
    absent, own = absent_keys(unet), unet.state_dict()
    for key in sorted(set(own) - absent):
        if key not in state:
            raise InputError(f"{what} lacks the tensor '{key}', unlike LightningDrag's; get the right file.")
        if state[key].shape != own[key].shape:
            raise InputError(
                f"{what} has '{key}' as {tuple(state[key].shape)}, but the base model needs {tuple(own[key].shape)}; "
                "choose models that belong together."
            )
    for key in sorted(state):
        if key in absent:
            raise InputError(f"{what} has the tensor '{key}', unlike LightningDrag's; get the right file.")
        if key not in own:
            raise InputError(f"{what} has a tensor '{key}' of another model; get the right file.")
    unet.load_state_dict({key: tensor.to(dtype) for key, tensor in state.items()}, strict=False, assign=True)
    prune(unet)
    return unet


@dataclass(frozen=True)
class IPAdapter:
    """The two halves of an IP-Adapter's file `what`: projection, of the image to tokens; cross, keys and values of the
    cross-attentions, named by their number among all attentions."""

    what: str
    projection: dict[str, Any]
    cross: dict[str, Any]


def read_ip_adapter(path: Path, processors: nn.ModuleList) -> IPAdapter:
    """The IP-Adapter in `path`, whose keys and values fit the cross-attentions of `processors`.

    Raises:
        InputError: it is none, or one of another model.
    """
    what = f"The IP-Adapter '{path}'"
    groups: dict[str, dict[str, Any]] = {"image_proj": {}, "ip_adapter": {}}
    for key, value in load_tensors(path, "IP-Adapter").items():
        group, _, rest = str(key).partition(".")
        if group not in groups or not (rest or isinstance(value, dict)):
            raise InputError(f"{what} has '{key}', which does not belong there; choose ip-adapter_sd15.")
        groups[group].update({rest: value} if rest else value)
    cross = nn.ModuleDict({str(i): processors[i] for i in range(1, len(processors), 2)})
    check_tensors(cross, groups["ip_adapter"], what)
    return IPAdapter(what, groups["image_proj"], groups["ip_adapter"])


def load_image_tokens(adapter: IPAdapter, width: int, context: int) -> ImageTokens:
    """The adapter's projection of image embeddings of `width` to tokens of `context`. Raises InputError."""
    tokens = ImageTokens(width, context)
    load_strictly(tokens, adapter.projection, adapter.what)
    return tokens


def empty_prompt(base: Path, width: int) -> torch.Tensor:
    """The text encoder's states (1, 77, width) of "", float32; the encoder is let go."""
    from transformers import CLIPTextModel, CLIPTokenizer

    encoder = _pretrained(CLIPTextModel, base / "text_encoder", "text encoder", dtype=torch.float32)
    if encoder.config.hidden_size != width:
        raise InputError(
            f"The text encoder in '{base}' has width {encoder.config.hidden_size}, its UNet takes {width}; "
            "choose a whole model."
        )
    try:
        tokenizer = CLIPTokenizer.from_pretrained(base / "tokenizer", local_files_only=True)
        length = encoder.config.max_position_embeddings
        if len(tokenizer) < encoder.config.vocab_size:
            raise ValueError(f"it knows {len(tokenizer)} words, the text encoder {encoder.config.vocab_size}")
        tokens = tokenizer("", padding="max_length", max_length=length, return_tensors="pt").input_ids
        with torch.no_grad():
            states: torch.Tensor = encoder(tokens)[0]
    except Exception as error:  # of tokenizers, of transformers
        raise InputError(
            f"The tokenizer in '{base}' does not work ({first_line(error)}); get its files again."
        ) from error
    return states


def _pretrained(kind: Any, folder: Path, what: str, **settings: Any) -> Any:
    """A model of diffusers or transformers from a local folder, with every tensor from the file."""
    names = {path.name for path in folder.iterdir()}
    if not any(
        f"{stem}.{end}" in names
        for stem in ("diffusion_pytorch_model", "model", "pytorch_model")
        for end in ("safetensors", "bin")
    ):
        settings["variant"] = "fp16"
    pickles = sorted(name for name in names if name.endswith(".bin"))
    if pickles and not any(name.endswith(".safetensors") for name in names):
        check_pickle_reader(what, folder / pickles[0])
    try:
        model, report = kind.from_pretrained(folder, local_files_only=True, output_loading_info=True, **settings)
    except Exception as error:  # each library has its own
        raise InputError(
            f"The {what} in '{folder}' cannot be loaded ({first_line(error)}); get its files again."
        ) from error
    for complaint, words in (("missing_keys", "lacks the tensor"), ("mismatched_keys", "has another shape of")):
        if report[complaint]:
            first = sorted(str(key) for key in report[complaint])[0]
            raise InputError(f"The {what} in '{folder}' {words} '{first}'; get the right files.")
    extra = too_many(kind, report)
    if extra:
        raise InputError(
            f"The config.json of the {what} in '{folder}' has no place for '{extra[0]}'; get the right files."
        )
    check_numbers(f"The {what} in '{folder}'", model.named_parameters())
    return model


def _check_vae(config: Any, folder: Path) -> None:
    """Raise InputError unless the latents are those of Stable Diffusion 1.5, whose tensors others have, too."""
    if config.latent_channels != 4 or len(config.block_out_channels) != 4:
        raise InputError(f"The VAE in '{folder}' is not one of Stable Diffusion 1.5; choose such a one.")
    for name, wanted in (("scaling_factor", SCALING), ("shift_factor", None), ("latents_mean", None)):
        given = getattr(config, name, wanted) or None
        if given != wanted:
            raise InputError(
                f"The VAE in '{folder}' has the {name} {given!r}, not {wanted!r}, so it is not one of Stable Diffusion "
                "1.5; choose such a one, as sd-vae-ft-mse."
            )


def _quiet() -> None:
    """No progress bars of the libraries: the worker has its own."""
    from diffusers.utils import logging as of_diffusers
    from transformers.utils import logging as of_transformers

    loggers: tuple[Any, ...] = (of_diffusers, of_transformers)
    for logger in loggers:
        logger.disable_progress_bar()


def _ip_adapter_file(folder: Path) -> Path:
    path = folder / "models/ip-adapter_sd15.bin"
    return path if path.is_file() else path.with_suffix(".safetensors")


def _scheduler(path: Path) -> dict[str, Any]:
    """The base model's schedule of noise; everything that diffusers would make up must be said there."""
    config = read_table(path)
    if config.get("prediction_type", "epsilon") != "epsilon":
        raise InputError(
            f"The base model's '{path}' says that it predicts {config['prediction_type']}, not epsilon; "
            "choose a Stable Diffusion 1.5 inpainting model."
        )
    needed = () if config.get("trained_betas") else ("beta_start", "beta_end", "beta_schedule")
    for name in needed:
        if name not in config:
            raise InputError(f"The base model's '{path}' does not say its {name}; get the file again.")
    try:
        for kind in ("ddim", "lcm"):
            schedule = Schedule.of(kind).scheduler(config, torch.device("cpu"))
            kept = schedule.alphas_cumprod
            if len(kept) != FIRST_TIMESTEP + 1 or not 0 < kept[-1] < kept[0] < 1 or not (kept.diff() < 0).all():
                raise ValueError(f"{len(kept)} times whose noise does not grow from 0 to 1")
            if not 0 <= int(schedule.timesteps.min()) <= int(schedule.timesteps.max()) <= FIRST_TIMESTEP:
                raise ValueError("steps at times that it does not have")
    except Exception as error:  # of diffusers, torch, numpy
        raise InputError(
            f"The base model's '{path}' holds no schedule of noise that works ({first_line(error)}); get the file of "
            "a Stable Diffusion 1.5 inpainting model."
        ) from error
    return config
