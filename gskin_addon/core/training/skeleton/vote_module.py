# SPDX-License-Identifier: GPL-3.0-or-later
"""The network of core/skeleton/votes.py in torch, to be trained; the same parameters by the same names."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ...skeleton.votes import FEATURES


class VoteModule(nn.Module):
    """Joints of the left side and the middle from batches of voxels."""

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, joints: int, width: int, mean: Any, deviation: Any) -> None:
        """mean, deviation (FEATURES,): of the features in the examples."""
        super().__init__()
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("deviation", torch.as_tensor(deviation, dtype=torch.float32))
        self.enter = nn.Sequential(nn.Linear(FEATURES, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.whole = nn.Linear(2 * width, width)
        self.mix = nn.Linear(2 * width, width)
        self.say = nn.Linear(width, 4 * joints)
        self.look = nn.Sequential(nn.Linear(2 * width, width // 2), nn.ReLU(), nn.Linear(width // 2, 1))

    def forward(self, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """joints (E, J, 3), places (E, M, J, 3), weight (E, M, J), fits (E,) of values (E, M, FEATURES)."""
        x = self.enter((values - self.mean) / self.deviation)
        pooled = torch.cat([x.mean(dim=1), x.amax(dim=1)], dim=1)
        whole = torch.relu(self.whole(pooled))
        x = torch.relu(self.mix(torch.cat([x, whole[:, None].expand_as(x)], dim=2)))
        said = self.say(x).unflatten(2, (-1, 4))
        weight = torch.softmax(said[..., 0], dim=1)
        places = values[:, :, None, :3] + said[..., 1:]
        joints = (weight[..., None] * places).sum(dim=1)
        return joints, places, weight, self.look(pooled)[:, 0]
