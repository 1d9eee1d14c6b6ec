# SPDX-License-Identifier: GPL-3.0-or-later
"""Initial weights by a small network that has seen how artists weight bodies. See docs/model-card.md."""

from __future__ import annotations
