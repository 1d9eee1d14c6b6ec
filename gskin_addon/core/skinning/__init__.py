# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial weights, the weight field, the losses and the optimisation loop."""

from __future__ import annotations
