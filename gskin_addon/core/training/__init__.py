# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of guidance models: rigged assets, image pairs made from them, and the fine-tuning."""

from __future__ import annotations
