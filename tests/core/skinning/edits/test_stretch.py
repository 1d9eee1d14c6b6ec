# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a pose pulls neighbouring splats apart, on a line of splats whose lengths are known."""

from __future__ import annotations

import numpy as np

from gskin_addon.core.rig.lbs import skin_points
from gskin_addon.core.skinning.edits.body_graph import body_graph
from gskin_addon.core.skinning.edits.stretch import SOFT, StretchMeter


def test_posing_is_linear_blend_skinning():
    rng = np.random.default_rng(3)
    means = rng.normal(size=(50, 3)).astype(np.float32)
    index = np.stack([rng.permutation(4)[:3] for _ in range(50)])
    value = rng.dirichlet(np.ones(3), 50).astype(np.float32)
    index[7], value[7] = -1, (1, 0, 0)
    dense = np.zeros((50, 4))
    np.put_along_axis(dense, np.maximum(index, 0), value, axis=1)
    transforms = np.tile(np.eye(4), (4, 1, 1))
    transforms[:, :3] += rng.normal(0, 0.3, (4, 3, 4))
    posed = StretchMeter(means, body_graph(means), index, value).posed(transforms)
    wanted = skin_points(means.astype(np.float64), dense, transforms)
    wanted[7] = means[7]
    np.testing.assert_allclose(posed, wanted, atol=1e-5)


def test_only_what_is_torn_apart_stretches():
    means = np.stack([np.arange(30) * 0.1, np.zeros(30), np.zeros(30)], axis=1).astype(np.float32)
    index = np.where(np.arange(30) < 15, 0, 1)[:, None]
    value = np.ones((30, 1), np.float32)
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[1, 0, 3] = 0.3  # the second half moves away by three times the spacing
    graph = body_graph(means, neighbours=2)
    found = StretchMeter(means, graph, index, value).measure(transforms)
    soft = SOFT * 2.9
    np.testing.assert_allclose(found[[14, 15]], (0.4 + soft) / (0.1 + soft), rtol=1e-4)
    np.testing.assert_allclose(np.delete(found, [14, 15]), 1.0, atol=1e-5)
    transforms[:, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # all turn: nothing stretches
    transforms[:, :3, 3] = 0
    np.testing.assert_allclose(StretchMeter(means, graph, index, value).measure(transforms), 1.0, atol=1e-5)
    # A seam between the halves: they only touch.
    walls = np.where(np.arange(30) < 15, 1, 2)
    transforms[1, 0, 3] = 0.3
    seam = StretchMeter(means, body_graph(means, neighbours=2, walls=walls), index, value)
    np.testing.assert_allclose(seam.measure(transforms), 1.0, atol=1e-5)
