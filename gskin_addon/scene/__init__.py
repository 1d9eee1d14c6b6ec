# SPDX-License-Identifier: GPL-3.0-or-later
"""The only place where Blender's data and core's arrays meet."""

from __future__ import annotations
