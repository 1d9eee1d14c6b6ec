# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of `gskin train-guidance tune --model flux2`. Standard library only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...guidance.options import Flux2Options, one_of, ranged, unseen


@dataclass(frozen=True)
class Flux2TuneOptions(Flux2Options):
    """The model as for `flux2`, and how to train its LoRA.

    lora: a LoRA to start from, whose rank then counts; rank: of a new one; batch: examples of an update, one after
    the other on the device; learning_rate, weight_decay: of AdamW; clip: largest norm of the gradients; epochs,
    updates: when to end, the latter unless 0; checkpointing: compute activations twice to save memory; save_minutes:
    between checkpoints; validation: pairs to validate on before and after, 0 for none; steps, guidance_scale: of the
    validation's sampling; lpips: a TorchScript file of LPIPS, to validate with it too; seed: of everything.
    """

    # Half precision of training needs a scaler of gradients; bfloat16 does not.
    dtype: str = one_of("auto", ("auto", "float32", "bfloat16"))
    offload: str = unseen("none", choices=("none",))
    batch: int = ranged(4, 1, 1024)
    rank: int = ranged(32, 1, 1024)
    learning_rate: float = ranged(1e-4, 0.0, 1.0)
    weight_decay: float = ranged(0.01, 0.0, 1.0)
    clip: float = ranged(1.0, 0.0, 1e6)
    epochs: int = unseen(4, range=(1, 100_000))
    updates: int = unseen(0, range=(0, 1_000_000_000))
    checkpointing: bool = unseen(True)
    save_minutes: float = unseen(10.0, range=(0.0, 1e6))
    validation: int = unseen(64, range=(0, 1_000_000))
    lpips: str = unseen("")
    seed: int = ranged(0, 0, 2**32 - 1)

    def identity(self) -> dict[str, Any]:
        """The settings that decide the weights; which model is used is told by its files, not its place."""
        left_out = ("steps", "guidance_scale", "model", "lora")
        return {name: value for name, value in super().identity().items() if name not in left_out}
