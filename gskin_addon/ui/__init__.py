# SPDX-License-Identifier: GPL-3.0-or-later
"""Panel, preferences, properties, and the drawing of progress."""

from __future__ import annotations
