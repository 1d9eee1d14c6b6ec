# SPDX-License-Identifier: GPL-3.0-or-later
"""What this Blender knows: chosen objects, preferences, readiness, running jobs."""

from __future__ import annotations
