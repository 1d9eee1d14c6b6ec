# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of `gskin train-guidance tune`. Standard library only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...guidance.options import LightningDragOptions, one_of, ranged, unseen

ROLES = ("models", "base", "vae", "ip_adapter", "lightning_drag", "lcm_lora")


@dataclass(frozen=True)
class TuneOptions(LightningDragOptions):
    """Models as for `lightning_drag`, and how to train.

    batch, accumulate: examples at once on each device, and how many such batches make an update; learning_rate,
    weight_decay: of AdamW; clip: largest norm of the gradients; drop: part of the examples that do not see their
    points; ema: decay of the averaged weights, which are what is kept, 0 for none; epochs, updates: when to end,
    the latter unless 0; checkpointing: compute activations twice to save memory; workers: processes that read
    pairs; save_minutes: between checkpoints; validation: pairs to validate on, 0 for none; validate_every: epochs
    between validations, 0 for only before and after; steps, guidance_scale: of the validation's DDIM sampling;
    lpips: a TorchScript file of LPIPS, to validate with it too; seed: of everything.
    """

    scheduler: str = one_of("ddim", ("ddim",))
    batch: int = ranged(8, 1, 1024)
    accumulate: int = ranged(1, 1, 1024)
    learning_rate: float = ranged(1e-5, 0.0, 1.0)
    weight_decay: float = ranged(0.01, 0.0, 1.0)
    clip: float = ranged(1.0, 0.0, 1e6)
    drop: float = ranged(0.1, 0.0, 1.0)
    ema: float = ranged(0.9999, 0.0, 1.0)
    epochs: int = unseen(64, range=(1, 100_000))
    updates: int = unseen(0, range=(0, 1_000_000_000))
    checkpointing: bool = unseen(True)
    workers: int = unseen(0, range=(0, 256))
    save_minutes: float = unseen(10.0, range=(0.0, 1e6))
    validation: int = unseen(64, range=(0, 1_000_000))
    validate_every: int = unseen(0, range=(0, 100_000))
    lpips: str = unseen("")
    seed: int = ranged(0, 0, 2**32 - 1)

    def identity(self) -> dict[str, Any]:
        """The settings that decide the weights; which models are used is told by their files, not their places."""
        sampling = ("steps", "guidance_scale", "max_points", *ROLES)
        return {name: value for name, value in super().identity().items() if name not in sampling}
