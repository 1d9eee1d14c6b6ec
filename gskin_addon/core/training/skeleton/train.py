# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of a network that finds joints, on examples of rigged meshes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...skeleton.joints import MIDDLE, both_sides
from ...skeleton.votes import mirrored
from .examples import Example
from .vote_module import VoteModule

Array = NDArray[Any]

WIDTH, STEPS, BATCH, RATE = 64, 1500, 12, 2e-3
LOOSE = 0.15
"""Weight of the votes' own errors beside that of their mean."""


def train(
    examples: Sequence[Example],
    families: Sequence[str],
    names: tuple[str, ...],
    *,
    steps: int = STEPS,
    width: int = WIDTH,
    seed: int = 0,
    told: Callable[[str], None] = lambda _: None,
) -> dict[str, Array]:
    """The parameters of a `VoteNetwork` for the joints `names` (of one side), float16.

    families: of each example; all count alike by the square root of their size. Each example is shown as it is or
    mirrored, and for `fits` also turned by quarters.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    sizes = Counter(families)
    chance = np.array([sizes[family] ** -0.5 for family in families])
    chance /= chance.sum()
    left, right = side_columns(names)
    values = np.stack([example.values for example in examples]).astype(np.float32)
    joints = np.stack([example.joints for example in examples]).astype(np.float32)
    diagonals = np.array([example.diagonal for example in examples], np.float32)
    rows_of = values.reshape(-1, values.shape[2])
    module = VoteModule(len(names), width, rows_of.mean(axis=0), rows_of.std(axis=0) + 1e-3)
    optimiser = torch.optim.AdamW(module.parameters(), lr=RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps, pct_start=0.1)
    mean_loss = 0.0
    for step in range(steps):
        rows = rng.choice(len(examples), BATCH, p=chance)
        flip = rng.random(BATCH) < 0.5
        shown, goal = values[rows], joints[rows][:, left]
        shown[flip] = mirrored(shown[flip])
        goal[flip] = joints[rows[flip]][:, right] * np.array([-1, 1, 1], np.float32)
        wrong = turned_by_quarters(shown[:4], rng.integers(1, 4, 4))
        known = torch.from_numpy(np.isfinite(goal).all(axis=2))
        goal_t = torch.from_numpy(np.nan_to_num(goal))
        found, places, weight, fits = module(torch.from_numpy(shown))
        unit = 1.0 / torch.from_numpy(diagonals[rows])[:, None]
        off = torch.linalg.vector_norm(found - goal_t, dim=2) * unit
        each = (weight * torch.linalg.vector_norm(places - goal_t[:, None], dim=3)).sum(dim=1) * unit
        loss = ((off + LOOSE * each) * known).sum() / known.sum()
        pooled_wrong = module(torch.from_numpy(wrong))[3]
        look = torch.nn.functional.softplus(-fits).mean() + torch.nn.functional.softplus(pooled_wrong).mean()
        optimiser.zero_grad()
        (loss + 0.01 * look).backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        mean_loss += ((off * known).sum() / known.sum()).item()
        if (step + 1) % 250 == 0:
            told(f"{step + 1} steps: joints off by {100 * mean_loss / 250:.2f} % of the diagonal")
            mean_loss = 0.0
    return {name: value.detach().numpy().astype(np.float16) for name, value in module.state_dict().items()}


def side_columns(names: tuple[str, ...]) -> tuple[Array, Array]:
    """Columns in `both_sides` of the joints of the left side with the middle, and of the right side with it."""
    place = {name: number for number, name in enumerate(both_sides(names))}
    sides = [[place[name if name in MIDDLE else f"{name}.{side}"] for name in names] for side in "LR"]
    return np.array(sides[0]), np.array(sides[1])


def turned_by_quarters(values: Array, quarters: Array) -> Array:
    """Features (E, M, FEATURES) of bodies turned about z by quarters (E,)."""
    out = values.copy()
    starts = (0, *range(8, 8 + 15, 3), values.shape[2] - 9, values.shape[2] - 6)
    for example, quarter in enumerate(quarters):
        cosine, sine = round(np.cos(quarter * np.pi / 2)), round(np.sin(quarter * np.pi / 2))
        for at in starts:
            x, y = values[example, :, at], values[example, :, at + 1]
            out[example, :, at], out[example, :, at + 1] = cosine * x - sine * y, sine * x + cosine * y
        if quarter % 2:
            box = values.shape[2] - 3
            out[example, :, box], out[example, :, box + 1] = values[example, :, box + 1], values[example, :, box]
    return out
