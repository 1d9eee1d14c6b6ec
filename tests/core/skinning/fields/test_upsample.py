# SPDX-License-Identifier: GPL-3.0-or-later
"""The sparse transposed convolution against torch's dense one."""

from __future__ import annotations

import numpy as np
import torch

from gskin_addon.core.skinning.fields.upsample import SparseUpsample, coarse_places

INPUTS, OUTPUTS, COARSE = 3, 5, 4
TAPS = [[1, 3], [2, 0]]  # kernel tap by parity of the fine voxel, then source


def dense_kernel(weight):
    """The weights as ConvTranspose3d keeps them, (inputs, outputs, 4, 4, 4)."""
    kernel = torch.zeros(INPUTS, OUTPUTS, 4, 4, 4, dtype=weight.dtype)
    split = weight.reshape(2, 2, 2, 2, 2, 2, INPUTS, OUTPUTS)
    for parity in np.ndindex(2, 2, 2):
        for source in np.ndindex(2, 2, 2):
            x, y, z = (TAPS[p][s] for p, s in zip(parity, source, strict=True))
            kernel[:, :, x, y, z] = split[parity][source]
    return kernel


def make(fine):
    places = coarse_places(fine, COARSE)
    layer = SparseUpsample(fine, places, COARSE, INPUTS, OUTPUTS).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        layer.weight.normal_(generator=generator)
        layer.bias.normal_(generator=generator)
    return places, layer


def test_equals_the_dense_layer_with_its_gradients():
    rng = np.random.default_rng(0)
    everywhere = np.stack(np.unravel_index(np.arange((2 * COARSE) ** 3), (2 * COARSE,) * 3), 1)
    fine = everywhere[np.sort(rng.choice(len(everywhere), 60, replace=False))]
    places, layer = make(fine)
    assert len(places) < COARSE**3  # some coarse voxels are not needed
    volume = torch.randn(1, INPUTS, COARSE, COARSE, COARSE, dtype=torch.float64, requires_grad=True)
    features = volume.detach()[0, :, *places.T].T.clone().requires_grad_()
    kernel = dense_kernel(layer.weight.detach()).requires_grad_()
    dense = torch.nn.functional.conv_transpose3d(volume, kernel, layer.bias.detach(), stride=2, padding=1)
    expected = dense[0, :, *fine.T].T
    found = layer(features)
    np.testing.assert_allclose(found.detach(), expected.detach(), atol=1e-12)

    pull = torch.randn(expected.shape, dtype=torch.float64)
    (expected * pull).sum().backward()
    (found * pull).sum().backward()
    np.testing.assert_allclose(features.grad, volume.grad[0, :, *places.T].T, atol=1e-12)
    np.testing.assert_allclose(dense_kernel(layer.weight.grad), kernel.grad, atol=1e-12)
    np.testing.assert_allclose(layer.bias.grad, pull.sum(0), atol=1e-12)


def test_a_single_voxel_at_the_border():
    places, layer = make(np.array([[0, 0, 7]]))
    assert places.tolist() == [[0, 0, 3]]
    assert layer(torch.ones(1, INPUTS, dtype=torch.float64)).shape == (1, OUTPUTS)
