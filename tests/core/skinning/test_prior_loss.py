# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import numpy as np
import pytest
import torch

from gskin_addon.core.skinning.fields.pyramid import SparsePyramid
from gskin_addon.core.skinning.prior_loss import PriorLoss


@pytest.fixture
def field():
    rng = np.random.default_rng(0)
    return SparsePyramid(rng.random((60, 3)), rng.dirichlet(np.ones(4), 60).astype(np.float32))


def test_initial_weights_cost_nothing_and_others_their_divergence(field):
    rng = np.random.default_rng(1)
    prior_loss = PriorLoss(field)
    assert float(prior_loss.loss(field.initial(), rng)) == pytest.approx(0, abs=1e-6)
    p = field.initial().double().numpy()
    q = rng.dirichlet(np.ones(4), 60)
    expected = (p * np.log(p / q)).sum(1).mean()
    assert float(prior_loss.loss(torch.tensor(q), rng)) == pytest.approx(expected, rel=1e-4)


def test_the_pull_on_the_logits_is_the_difference_of_the_weights(field):
    """It does not fade for a splat that has lost its bone altogether."""
    logits = torch.randn(60, 4, generator=torch.Generator().manual_seed(0)) * 6
    logits.requires_grad_()
    weights = torch.softmax(logits, 1)
    PriorLoss(field).loss(weights, np.random.default_rng(0)).backward()
    np.testing.assert_allclose(logits.grad * 60, (weights - field.initial()).detach(), atol=1e-4)


def test_doubtful_nodes_are_free(field):
    confidence = np.zeros(60)
    confidence[:30] = 1
    logits = torch.zeros(60, 4, requires_grad=True)
    PriorLoss(field, confidence).loss(torch.softmax(logits, 1), np.random.default_rng(0)).backward()
    assert logits.grad[30:].abs().max() == 0
    assert logits.grad[:30].abs().max() > 1e-4
    with pytest.raises(ValueError, match="shape"):
        PriorLoss(field, np.ones(3))
