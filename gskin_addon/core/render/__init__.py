# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras, the splat rasteriser with its backends, and the image losses and metrics."""

from __future__ import annotations
