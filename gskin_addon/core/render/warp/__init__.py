# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasteriser on NVIDIA Warp."""

from __future__ import annotations
