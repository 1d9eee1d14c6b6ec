# SPDX-License-Identifier: GPL-3.0-or-later
"""Fine-tuning LightningDrag on image pairs (Sec. IV): the loop, its checkpoints, and what it leaves behind."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from ...guidance.diffusion import compute_device
from ...guidance.lightning_drag.files import FINE_TUNED, Files, find_files, read_table
from ...guidance.lightning_drag.pipeline import LightningDragPainter, Schedule
from ...guidance.lightning_drag.point_maps import SPARSE, check_size
from ...guidance.lightning_drag.weights import load
from ...guidance.model_files import require
from .drag_loss import DragLoss, trained_parameters
from .examples import Examples, batches
from .pairs import PairDataset, read_manifest
from .split import VALIDATION
from .training_loop import Report, TrainingLoop, diverged
from .tune_options import TuneOptions
from .tune_state import Average, load_state, put, save_state, write_checkpoint
from .validate import load_lpips, validate

PRECISION = {torch.float32: "no", torch.float16: "fp16", torch.bfloat16: "bf16"}


def tune(
    pairs: Path, out: Path, settings: Mapping[str, Any], report: Report, *, allow_download: bool = False
) -> str:
    """Fine-tune LightningDrag on the data set `pairs` and write it to `out`; returns a sentence on how it went.

    The same call goes on from the last checkpoint of a stopped one. `out` is then a checkpoint that the guidance
    `lightning_drag` takes. allow_download: the person agreed to fetch models that are missing.

    Raises:
        InputError: settings, models or pairs that cannot be used, or `out` holds another training.
    """
    options = TuneOptions.parse(settings, "lightning_drag")
    for package in ("diffusers", "transformers", "accelerate", "safetensors"):
        require(package, "Fine-tuning")
    data = PairDataset(pairs)
    check_size(data.size, data.size)
    files = find_files(options, lambda message: report(0.0, message), allow_download=allow_download)
    training = Training(options, files, data, validation_pairs(pairs), _identity(options, files, pairs), out)
    if not training.is_finished():
        out.mkdir(parents=True, exist_ok=True)
        training.prepare(report)
        training.run(report)
    report(1.0, "finished")
    return summary(read_table(out / FINE_TUNED), out)


class Training(TrainingLoop):
    """One training of LightningDrag."""

    def __init__(
        self,
        options: TuneOptions,
        files: Files,
        data: PairDataset,
        held_out: PairDataset | None,
        identity: Mapping[str, Any],
        out: Path,
    ) -> None:
        from accelerate import Accelerator

        device, self._dtype = compute_device(options.device, options.dtype, half="bfloat16")
        self._accelerator = Accelerator(
            mixed_precision=PRECISION[self._dtype],
            gradient_accumulation_steps=options.accumulate,
            cpu=device.type == "cpu",
        )
        size = options.batch * options.accumulate * self._accelerator.num_processes
        super().__init__(options, data, held_out, identity, out, size)
        self._files = files

    def prepare(self, report: Report) -> None:
        """Load the models, and the checkpoint where there is one."""
        options, accelerator = self._options, self._accelerator
        report(0.0, "Loading the models")
        self._lpips = load_lpips(options.lpips) if options.lpips else None
        self._model = load(self._files, self._dtype, trained=torch.float32)
        self._parameters = trained_parameters(self._model)
        for value in self._parameters.values():
            value.requires_grad_(True)
        if options.checkpointing:
            self._model.unet.enable_gradient_checkpointing()
            self._model.appearance.enable_gradient_checkpointing()
        loss = DragLoss(self._model, options.drop, accelerator.device, self._dtype)
        adam = torch.optim.AdamW(self._parameters.values(), lr=options.learning_rate, weight_decay=options.weight_decay)
        state = load_state(self._out, self._identity)
        if state is not None:
            put(self._parameters, state["weights"])
        self._loss, self._adam = accelerator.prepare(loss, adam)
        self._average = Average(self._parameters, options.ema)
        if state is not None:
            self._restore(state)

    def _after_update(self, report: Report) -> None:
        every = self._options.validate_every * math.ceil(len(self._data) / self._size)
        if every and self._update % every == 0:
            self._validate(f"update {self._update}", report)
            self._write()

    def _updates(self) -> Iterator[float]:
        """The mean loss of each update, as it is done."""
        options, accelerator = self._options, self._accelerator
        examples = Examples(self._data, self._size, self._model.image_encoder.config.image_size, options.seed)
        loader = batches(
            examples,
            range(self._update, self.total),
            options.batch,
            options.accumulate,
            process=accelerator.process_index,
            processes=accelerator.num_processes,
            workers=options.workers,
        )
        parts: list[float] = []
        for batch in loader:
            with accelerator.accumulate(self._loss):
                loss = self._loss(batch)
                accelerator.backward(loss)
                if accelerator.sync_gradients and options.clip:
                    accelerator.clip_grad_norm_(self._parameters.values(), options.clip)
                self._adam.step()
                self._adam.zero_grad()
            parts.append(float(loss.detach()))
            if len(parts) == options.accumulate:
                mean = sum(parts) / len(parts)
                if not math.isfinite(mean) and accelerator.scaler is None:
                    raise diverged()
                self._average.update(self._update + 1)
                parts = []
                yield mean

    def _validate(self, when: str, report: Report) -> None:
        options = self._options
        if self._held_out is None or self._is_validated(when):
            return
        if not self._accelerator.is_main_process:
            self._accelerator.wait_for_everyone()
            return
        tuned = when != "before"
        start = self._files.fine_tuned().get("max_points", SPARSE if options.max_points < 0 else options.max_points)
        painter = LightningDragPainter(
            self._model,
            Schedule.of("ddim", options.steps, options.guidance_scale),
            device=self._accelerator.device,
            dtype=self._dtype,
            batch=options.batch,
            max_points=0 if tuned else int(start),
        )
        tell = self._telling(when, report)
        with self._average.in_place(), self._accelerator.autocast():
            self._scores[when] = validate(painter, self._held_out, options.validation, options.seed, tell, self._lpips)
        self._accelerator.wait_for_everyone()

    def _save(self) -> None:
        if not self._accelerator.is_main_process:
            return
        save_state(self._out, self._state(self._adam, self._average.values, self._accelerator.scaler))

    def _restore(self, state: Mapping[str, Any]) -> None:
        self._adam.load_state_dict(state["adam"])
        for name, value in self._average.values.items():
            value.copy_(state["average"][name])
        if self._accelerator.scaler is not None and state["scaler"] is not None:
            self._accelerator.scaler.load_state_dict(state["scaler"])
        self._go_on_from(state)

    def _write(self) -> None:
        if not self._accelerator.is_main_process:
            return
        with self._average.in_place():
            write_checkpoint(self._model, self._out, self._files.lightning_drag, self._facts(max_points=0))


def validation_pairs(pairs: Path) -> PairDataset | None:
    """The held-out pairs of a data set, None where it has none."""
    has = any(shard["split"] == VALIDATION for shard in read_manifest(pairs)["shards"])
    return PairDataset(pairs, VALIDATION) if has else None


def _identity(options: TuneOptions, files: Files, pairs: Path) -> dict[str, Any]:
    """All that decides the trained weights, as plain values."""
    manifest = read_manifest(pairs)
    told = json.dumps([manifest["settings"], manifest["shards"]], sort_keys=True)
    # Times are left out: a copy of a model is the same model.
    sizes = {role: [[name, size] for name, size, _ in found] for role, found in files.stamps().items()}
    return {
        **options.identity(),
        "the pairs": hashlib.blake2b(told.encode(), digest_size=8).hexdigest(),
        "the models": hashlib.blake2b(json.dumps(sizes, sort_keys=True).encode(), digest_size=8).hexdigest(),
    }


def summary(facts: Mapping[str, Any], out: Path) -> str:
    """A sentence on a training that is finished, from its `fine_tuned.json`."""
    before, after = (facts["validation"].get(when) for when in ("before", "after"))
    if not before or not after:
        return f"'{out}' was fine-tuned by {facts['updates']:,} updates; there were no pairs to validate on."
    told = [
        ", ".join(
            f"{name.upper()} {before[kind + name]:.4g} -> {after[kind + name]:.4g}"
            for name in ("psnr", "ssim", "lpips")
            if kind + name in after
        )
        for kind in ("", "raw_")
    ]
    scores = " (raw images: ".join(part for part in told if part) + (")" if told[1] else "")
    return f"'{out}' was fine-tuned by {facts['updates']:,} updates; on {after['pairs']} held-out pairs {scores}."
