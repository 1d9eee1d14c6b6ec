# SPDX-License-Identifier: GPL-3.0-or-later
"""Training a LoRA of FLUX.2 [klein] on image pairs: rest view and drawn skeletons in, posed view out."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from ...files import replaced, write_json
from ...guidance.flux2 import ADAPTER, LORA, Flux2Painter, check_size, find_lora, references
from ...guidance.flux_repair import find_klein
from ...guidance.lightning_drag.files import FINE_TUNED, read_table
from ...guidance.model_files import require, stamp
from ...guidance.skeleton_image import DRAWING_VERSION
from .examples import pair_number
from .finetune import summary, validation_pairs
from .flux2_options import Flux2TuneOptions
from .pairs import Pair, PairDataset, read_manifest
from .training_loop import Report, TrainingLoop, diverged
from .tune_state import load_state, put, save_state
from .validate import load_lpips, validate

TARGETS = (
    r"(transformer_blocks\.\d+\.attn\.(to_q|to_k|to_v|to_out\.0|add_q_proj|add_k_proj|add_v_proj|to_add_out)"
    r"|single_transformer_blocks\.\d+\.attn\.(to_qkv_mlp_proj|to_out))"
)
"""The layers that get a LoRA: the projections of all attentions; in the single blocks these hold the MLP too."""


def tune(pairs: Path, out: Path, settings: Mapping[str, Any], report: Report, *, allow_download: bool = False) -> str:
    """Train a LoRA on the data set `pairs` and write it to `out`; returns a sentence on how it went.

    The same call goes on from the last checkpoint of a stopped one. `out` is then what the option `lora` of the
    guidance `flux2` takes. allow_download: the person agreed to fetch a model that is missing.

    Raises:
        InputError: settings, model or pairs that cannot be used, or `out` holds another training.
    """
    options = Flux2TuneOptions.parse(settings, "flux2")
    require("peft", "Training a LoRA for FLUX.2 [klein]")
    data, held_out = PairDataset(pairs), validation_pairs(pairs)
    references(data[0].rest, data[0].bones)  # pairs of an older gskin are refused before the model is loaded
    folder = find_klein(
        options.model, "Fine-tuning", allow_download=allow_download, tell=lambda message: report(0.0, message)
    )
    start = find_lora(options.lora) if options.lora.strip() else None
    training = Training(options, folder, data, held_out, _identity(options, folder, start, pairs), out)
    if not training.is_finished():
        out.mkdir(parents=True, exist_ok=True)
        training.prepare(report)
        training.run(report)
    report(1.0, "finished")
    return summary(read_table(out / FINE_TUNED), out)


class Training(TrainingLoop):
    """One training of a LoRA."""

    def __init__(
        self,
        options: Flux2TuneOptions,
        folder: Path,
        data: PairDataset,
        held_out: PairDataset | None,
        identity: Mapping[str, Any],
        out: Path,
    ) -> None:
        super().__init__(options, data, held_out, identity, out, options.batch)
        self._folder = folder

    def prepare(self, report: Report) -> None:
        """Load the model, add the LoRA, and load the checkpoint where there is one."""
        options = self._options
        report(0.0, "Loading FLUX.2 [klein]")
        self._lpips = load_lpips(options.lpips) if options.lpips else None
        self._painter = Flux2Painter(self._folder, options)
        check_size((self._data.size, self._data.size), self._painter.token)
        self._painter.pipeline.vae.requires_grad_(False)
        self._parameters = trained_parameters(self._painter, options)
        if options.checkpointing:
            self._painter.pipeline.transformer.enable_gradient_checkpointing()
        self._adam = torch.optim.AdamW(
            self._parameters.values(), lr=options.learning_rate, weight_decay=options.weight_decay
        )
        state = load_state(self._out, self._identity)
        if state is not None:
            put(self._parameters, state["weights"])
            self._adam.load_state_dict(state["adam"])
            self._go_on_from(state)

    def _updates(self) -> Iterator[float]:
        """The mean loss of each update, as it is done."""
        options = self._options
        for update in range(self._update, self.total):
            losses = []
            for place in range(options.batch):
                number = pair_number(len(self._data), options.seed, update * options.batch + place)
                stream = np.random.SeedSequence([options.seed, update, place]).generate_state(1, np.uint64)[0]
                randomness = torch.Generator().manual_seed(int(stream >> np.uint64(1)))
                loss = flow_loss(self._painter, self._data[number], randomness)
                torch.autograd.backward(loss / options.batch)
                losses.append(float(loss.detach()))
            mean = sum(losses) / len(losses)
            if not math.isfinite(mean):
                raise diverged()
            if options.clip:
                torch.nn.utils.clip_grad_norm_(self._parameters.values(), options.clip)
            self._adam.step()
            self._adam.zero_grad()
            yield mean

    def _validate(self, when: str, report: Report) -> None:
        if self._held_out is None or self._is_validated(when):
            return
        options, tell = self._options, self._telling(when, report)
        self._scores[when] = validate(
            self._painter, self._held_out, options.validation, options.seed, tell, self._lpips
        )

    def _save(self) -> None:
        save_state(self._out, self._state(self._adam, {}, None))

    def _write(self) -> None:
        write_lora(self._painter, self._out / LORA)
        write_json(self._out / FINE_TUNED, self._facts(model="flux2"))


def trained_parameters(painter: Flux2Painter, options: Flux2TuneOptions) -> dict[str, torch.nn.Parameter]:
    """The weights of the LoRA by name, float32 and the only ones with gradients; a new LoRA where none was loaded."""
    from peft import LoraConfig
    from peft.tuners.tuners_utils import BaseTunerLayer

    transformer = painter.pipeline.transformer
    if not any(isinstance(module, BaseTunerLayer) for module in transformer.modules()):
        torch.manual_seed(options.seed)
        transformer.add_adapter(
            LoraConfig(r=options.rank, lora_alpha=options.rank, target_modules=TARGETS), adapter_name=ADAPTER
        )
    parameters: dict[str, torch.nn.Parameter] = {}
    for name, value in transformer.named_parameters():
        value.requires_grad_(".lora_" in name)
        if value.requires_grad:
            value.data = value.data.float()
            parameters[name] = value
    return parameters


def flow_loss(painter: Flux2Painter, pair: Pair, randomness: torch.Generator) -> torch.Tensor:
    """The squared error of the velocity at a random time, of the whole image (Lipman et al. 2023, Eq. 23).

    The time is logit-normal, as Esser et al. 2024 (Sec. 3.1) found best; tokens, positions and time are as the
    pipeline gives them to the transformer.
    """
    pipeline = painter.pipeline
    clean, _ = painter.tokens([pair.posed])
    known, known_places = painter.tokens(references(pair.rest, pair.bones))
    device, dtype = clean.device, pipeline.transformer.dtype
    noise = torch.randn(clean.shape, generator=randomness).to(device)
    sigma = torch.sigmoid(torch.randn(1, generator=randomness)).to(device)
    clean = clean.float()
    noisy = (1 - sigma) * clean + sigma * noise
    height, width = (side // painter.token for side in pair.mask.shape)
    places = pipeline._prepare_latent_ids(clean.new_empty(1, 1, height, width)).to(device)
    predicted = pipeline.transformer(
        hidden_states=torch.cat([noisy.to(dtype), known.to(dtype)], dim=1),
        timestep=sigma.to(dtype),
        guidance=None,
        encoder_hidden_states=painter.prompt,
        txt_ids=pipeline._prepare_text_ids(painter.prompt).to(device),
        img_ids=torch.cat([places, known_places], dim=1),
        return_dict=False,
    )[0][:, : clean.shape[1]]
    return functional.mse_loss(predicted.float(), noise - clean)


def write_lora(painter: Flux2Painter, path: Path) -> None:
    """The LoRA in the layout of diffusers, whole or not at all."""
    from peft import get_peft_model_state_dict
    from safetensors.torch import save_file

    state = get_peft_model_state_dict(painter.pipeline.transformer, adapter_name=ADAPTER)
    plain = {f"transformer.{name}": value.detach().cpu().contiguous() for name, value in state.items()}
    with replaced(path) as temporary:
        save_file(plain, temporary, metadata={"format": "pt"})


def _identity(options: Flux2TuneOptions, folder: Path, start: Path | None, pairs: Path) -> dict[str, Any]:
    """All that decides the trained weights, as plain values."""
    manifest = read_manifest(pairs)
    told = {
        "the pairs": [manifest["settings"], manifest["shards"]],
        # Times are left out: a copy of a model is the same model.
        "the models": [
            [name, size] for name, size, _ in stamp(folder) + (stamp(start, (LORA,)) if start is not None else [])
        ],
    }
    digests = {
        name: hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=8).hexdigest()
        for name, value in told.items()
    }
    return {**options.identity(), "drawing": DRAWING_VERSION, **digests}
