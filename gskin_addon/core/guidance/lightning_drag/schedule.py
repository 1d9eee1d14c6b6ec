# SPDX-License-Identifier: GPL-3.0-or-later
"""LightningDrag's steps of denoising: DDIM, or LCM with its LoRA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

FIRST_TIMESTEP = 999
"""Where sampling starts: the last of training."""

_NOISE = ("num_train_timesteps", "trained_betas", "steps_offset", "prediction_type")


@dataclass(frozen=True)
class Schedule:
    """kind: "lcm" or "ddim"; steps; scale: of the points' guidance at the first step."""

    kind: str
    steps: int
    scale: float

    @classmethod
    def of(cls, kind: str, steps: int = 0, scale: float = 0.0) -> Schedule:
        """Published: 8 steps at 3 with LCM-LoRA, 25 steps at 4 with DDIM; 0 stands for these."""
        usual_steps, usual_scale = {"lcm": (8, 3.0), "ddim": (25, 4.0)}[kind]
        return cls(kind, steps or usual_steps, scale or usual_scale)

    def scale_at(self, step: int) -> float:
        """Inverse-square decay g_i = (g - 1) (1 - i / N)^2 + 1."""
        return (self.scale - 1.0) * (1.0 - step / self.steps) ** 2 + 1.0

    def scheduler(self, config: dict[str, Any], device: torch.device) -> Any:
        """A fresh scheduler of diffusers, from the base model's configuration, with its timesteps set."""
        from diffusers import DDIMScheduler, LCMScheduler

        kind: Any = LCMScheduler if self.kind == "lcm" else DDIMScheduler
        own = {} if self.kind == "lcm" else {"set_alpha_to_one": False}
        known = {k: v for k, v in config.items() if k.startswith("beta_") or k in _NOISE}
        scheduler = kind.from_config({**known, **own, "clip_sample": False})
        scheduler.set_timesteps(self.steps, device=device)
        return scheduler
