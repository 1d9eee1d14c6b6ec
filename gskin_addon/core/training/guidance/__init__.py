# SPDX-License-Identifier: GPL-3.0-or-later
"""Image pairs from rigged models, and fine-tuning of the guidance model on them."""

from __future__ import annotations
