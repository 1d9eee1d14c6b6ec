# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimiser of the network's matrices: momentum whose singular values are all made one (Jordan et al. 2024)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


class Muon(torch.optim.Optimizer):
    """For the (rows, columns) matrices of hidden layers; a small network learns in fewer steps than with Adam.

    A matrix of several stacked square blocks (queries, keys, values) is treated block by block.
    """

    def __init__(self, matrices: Iterable[Tensor], lr: float, momentum: float = 0.95, decay: float = 0.01) -> None:
        super().__init__(matrices, {"lr": lr, "momentum": momentum, "decay": decay})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One update."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                if not state:
                    state["momentum"] = torch.zeros_like(matrix)
                mean = state["momentum"].lerp_(matrix.grad, 1 - group["momentum"])
                ahead = matrix.grad.lerp(mean, group["momentum"])
                rows, columns = matrix.shape
                blocks = rows // columns if rows % columns == 0 else 1
                update = orthogonal(ahead.view(blocks, rows // blocks, columns)).view_as(matrix)
                stretch = max(1.0, rows / blocks / columns) ** 0.5
                matrix.mul_(1 - group["lr"] * group["decay"]).sub_(update, alpha=group["lr"] * stretch)


def orthogonal(matrices: Tensor, rounds: int = 5) -> Tensor:
    """(M, r, c) with the singular vectors of the input and singular values of about one (0.7 to 1.2).

    Newton-Schulz iteration of the odd quintic 3.4445 x - 4.775 x^3 + 2.0315 x^5.
    """
    wide = matrices.shape[1] < matrices.shape[2]
    x = matrices if wide else matrices.transpose(1, 2)
    x = x / (x.norm(dim=(1, 2), keepdim=True) + 1e-12)
    for _ in range(rounds):
        gram = x @ x.transpose(1, 2)
        x = 3.4445 * x + (-4.775 * gram + 2.0315 * gram @ gram) @ x
    return x if wide else x.transpose(1, 2)
