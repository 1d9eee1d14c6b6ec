# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import torch

from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.fields.refined import RefinedField


def test_own_logits_learn_only_after_their_time():
    rng = np.random.default_rng(0)
    start = rng.dirichlet(np.ones(3), 40).astype(np.float32)
    field = RefinedField(SparsePyramid(np.zeros((40, 3)) + 0.5, start), 0.5)  # splats in one place: one set of logits
    np.testing.assert_allclose(field().detach(), start, atol=1e-3)
    target = torch.from_numpy(rng.dirichlet(np.ones(3), 40)).float()
    adam = torch.optim.Adam(field.parameters(), lr=0.1)

    def learn(part, steps):
        for _ in range(steps):
            field.unlock(part)
            adam.zero_grad()
            loss = (field() - target).square().sum()
            loss.backward()
            adam.step()
        return float(loss.detach())

    learn(0.2, 50)
    assert not field.own.any()
    stuck = learn(0.4, 100)
    assert learn(0.6, 300) < 0.05 * stuck
