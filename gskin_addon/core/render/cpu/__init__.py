# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasteriser on the CPU: numba kernels."""

from __future__ import annotations
