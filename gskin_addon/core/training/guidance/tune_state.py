# SPDX-License-Identifier: GPL-3.0-or-later
"""The files of a training: a checkpoint to continue from, and weights in LightningDrag's published layout."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ...checkpoint import load_checkpoint, save_checkpoint
from ...errors import InputError
from ...files import replaced, write_atomically, write_json
from ...guidance.lightning_drag.files import APPEARANCE, ATTENTION, FINE_TUNED, POINTS
from ...guidance.lightning_drag.weights import LightningDrag

STATE, OLD_STATE = "training.safetensors", "training.pt"

PARTS = {"identity", "update", "weights", "average", "adam", "scaler", "scores", "losses", "since"}
"""What a checkpoint holds."""


class Average:
    """Exponential moving average of parameters; follows faster in the first updates."""

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        """decay: 0 to 1; 0 keeps no average."""
        self._parameters, self._decay = parameters, decay
        self.values = {name: value.detach().clone() for name, value in parameters.items()} if decay else {}

    @torch.no_grad()
    def update(self, updates: int) -> None:
        """Update the averages after the update number `updates`."""
        part = 1.0 - min(self._decay, (1 + updates) / (10 + updates))
        for name, value in self.values.items():
            value.lerp_(self._parameters[name].detach(), part)

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """Within the block, the parameters have their averages as values."""
        own = {name: self._parameters[name].detach().clone() for name in self.values}
        put(self._parameters, self.values)
        try:
            yield
        finally:
            put(self._parameters, own)


@torch.no_grad()
def put(parameters: Mapping[str, nn.Parameter], values: Mapping[str, torch.Tensor]) -> None:
    """Set `parameters` to the `values` of the same names."""
    for name, value in values.items():
        parameters[name].copy_(value)


def save_state(out: Path, state: Mapping[str, Any]) -> None:
    """Write the checkpoint atomically."""
    save_checkpoint(out / STATE, state)


def load_state(out: Path, identity: Mapping[str, Any]) -> dict[str, Any] | None:
    """The checkpoint in `out`, None where there is none yet.

    Raises:
        InputError: it cannot be read, or belongs to another training; says what differs.
    """
    path = out / STATE
    if not path.is_file():
        if (out / OLD_STATE).is_file():
            raise InputError(
                f"The checkpoint '{out / OLD_STATE}' is of an older gskin and cannot be read safely; "
                "delete it to start again."
            )
        return None
    state = load_checkpoint(path)
    found = state.get("identity")
    if not isinstance(found, dict) or not state.keys() >= PARTS:
        raise InputError(f"The checkpoint '{path}' cannot be read as one of this training; delete it to start again.")
    check_identity(out, found, identity)
    return state


def check_identity(out: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise InputError where the training in `out` is another one."""
    differs = [name for name in wanted if found.get(name) != wanted[name]]
    if differs:
        name = differs[0]
        short = f"was {found.get(name)!r}, is {wanted[name]!r}" if len(str(wanted[name])) < 40 else "differs"
        raise InputError(f"'{out}' holds a training with other settings ({name} {short}); choose another --out.")


def write_checkpoint(model: LightningDrag, out: Path, source: Path, facts: Mapping[str, Any]) -> None:
    """The trained weights in the published layout, with `facts` in fine_tuned.json, which is written last.

    source: the checkpoint that training started from, whose configuration is kept.
    """
    from safetensors.torch import save_file

    for folder in (APPEARANCE, str(Path(POINTS).parent)):
        (out / folder).mkdir(parents=True, exist_ok=True)
    plain = {name: value.detach().cpu().contiguous() for name, value in model.appearance.state_dict().items()}
    weights = out / APPEARANCE / "diffusion_pytorch_model.safetensors"
    with replaced(weights) as temporary:
        save_file(plain, temporary, metadata={"format": "pt"})
    config, theirs = out / APPEARANCE / "config.json", source / APPEARANCE / "config.json"
    if theirs.is_file() and not config.is_file():  # nobody reads it here, but it belongs to the layout
        shutil.copyfile(theirs, config)
    for name, module in ((POINTS, model.point_embedding), (ATTENTION, model.processors)):
        state = {key: value.detach().float().cpu() for key, value in module.state_dict().items()}
        write_atomically(out / name, partial(torch.save, state))
    write_json(out / FINE_TUNED, dict(facts))
